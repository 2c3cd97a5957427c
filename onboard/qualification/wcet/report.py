# SPDX-License-Identifier: MIT
"""The table of worst-case time: instructions run on a simulated processor, and the bound.

Reads the output of main.c for each target; ends with 1 if a call took more than its bound.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from dataclasses import dataclass, replace
from pathlib import Path

from bound import Bound, Case, bound_of, of_attitude, of_image
from loops import Source, check, read_source
from machine import Program

NAMES = {
    "`starcat_identify_frame`, triangles": Case(),
    "`starcat_identify_frame`, pyramids": Case(has_pairs=True),
    "triangles, no magnitudes": Case(has_magnitudes=False),
    "pyramids, no magnitudes": Case(has_pairs=True, has_magnitudes=False),
    "triangles, crowded": Case(is_crowded=True, has_magnitudes=False),
    "pyramids, crowded": Case(has_pairs=True, is_crowded=True, has_magnitudes=False),
    "triangles, unknown focal length": Case(is_unknown=True),
    "triangles, lens": Case(has_lens=True),
    "pyramids, lens": Case(has_pairs=True, has_lens=True),
    "triangles, votes": Case(has_votes=True),
    "pyramids, votes": Case(has_pairs=True, has_votes=True),
    "`starcat_track_frame`": Case(is_track=True),
}

BLOCKS_PER_TICK = 16
"""Default of ``starcat_settings``, with which ticks.c measures."""

WORK = (
    "scrubs or repairs",
    "checks a patch",
    "runs a patch",
    "checks an upload",
    "writes parity",
    "checks the other image before a change",
    "checks the other image as the one in use is lost",
)
"""What a tick does, by ``starcat_work``."""

WHOLE = {
    "starcat_start_session": 4,
    "starcat_mend_image": 4,
    "starcat_switch_image": 4,
    "starcat_apply_patch": 4,
}
"""Calls of a whole image, and as what multiple of checking it they are bounded."""


@dataclass(frozen=True)
class Call:
    """A line of main.c."""

    kind: str
    number: int
    instructions: int
    steps: int
    status: int
    case: Case
    genes: str


def read_calls(path: Path) -> tuple[list[Call], dict[str, list[int]]]:
    """Read what a run has printed: its calls, and its other lines."""
    calls, others = [], {}
    for line in path.read_text(encoding="utf-8").splitlines():
        words = line.split()
        if words and words[0] in ("tick", "whole"):
            words = ["_".join(words[:2]), *words[2:]]
        if len(words) == 7 and words[0] in "ors":
            flags = int(words[5])
            case = Case(
                is_track=bool(flags & 8),
                has_pairs=bool(flags & 16),
                is_crowded=bool(flags & 4),
                is_unknown=bool(flags & 2),
                has_lens=bool(flags & 1),
                has_magnitudes=bool(flags & 32),
                has_votes=bool(flags & 64),
            )
            number, took, steps, status = map(int, words[1:5])
            calls.append(Call(words[0], number, took, steps, status, case, words[6]))
        elif words:
            others[words[0]] = [int(word) for word in words[1:] if word.isdecimal()]
    if "done" not in others:
        raise SystemExit(f"{path}: the run did not end; see the file")
    return calls, others


class Target:
    """A processor: its program, its bounds, and the calls that were made on it."""

    def __init__(self, name: str, elfs: list[Path], tools: str, source: Source) -> None:
        self.name, self.source = name, source
        self.program = Program(elfs[0], tools, {file for file, _ in source.functions})
        self.bounds: dict[Case, Bound] = {}
        self.calls: list[Call] = []
        self.others: list[dict[str, list[int]]] = []
        for elf in elfs:
            calls, others = read_calls(elf.with_suffix(".txt"))
            self.calls += calls
            self.others.append(others)

    def bound(self, case: Case) -> Bound:
        """Find the bound of a case, once."""
        if case.is_track:  # no triangles are looked up
            case = replace(case, has_pairs=False, is_crowded=False)
        if case not in self.bounds:
            self.bounds[case] = bound_of(self.program, self.source, case)
        return self.bounds[case]

    def share(self, call: Call) -> float:
        """What a call took, of its bound."""
        return call.instructions / self.bound(call.case).of(call.steps)

    def rows(self) -> list[str]:
        """Rows of the table, by case."""
        by_case = defaultdict(list)
        for call in self.calls:
            by_case[call.case].append(call)
        rows = []
        for name, case in NAMES.items():
            bound = self.bound(case)
            calls = by_case[case]
            if case.is_track:
                calls = calls + by_case[replace(case, has_pairs=True)]
            ordinary = [call for call in calls if call.kind == "o"]
            made = [call for call in calls if call.kind != "o"]
            cells = [name, f"{len(calls):,}", most_of(ordinary), most_of(made)]
            cells += [f"{100.0 * max(map(self.share, calls), default=0.0):.0f} %"]
            cells += [f"{x:,.0f}" for x in (bound.once, bound.per_step, bound.per_look_up)]
            rows.append("| " + " | ".join(cells) + " |")
        return rows

    def image_rows(self) -> list[str]:
        """What opening and scrubbing take, and an attitude of pairs."""
        alone, block = of_image(self.program, self.source)
        rows, is_within = [], True
        for others in self.others:
            took, blocks = others["open"]
            is_within &= took <= alone + blocks * block and others["scrub"][0] <= alone + block
        took, blocks = self.others[0]["open"]
        rows.append(
            f"`starcat_open_image`, {blocks} blocks: {took:,} instructions, one block scrubbed "
            f"{self.others[0]['scrub'][0]:,}; bound {alone:,.0f} and {block:,.0f} a block"
        )
        alone, pair = of_attitude(self.program, self.source)
        for others in self.others:
            took, pairs = others["attitude"]
            is_within &= took <= alone + pairs * pair
        took, pairs = self.others[0]["attitude"]
        rows.append(
            f"`starcat_fit_attitude`, {pairs} pairs: {took:,} instructions; bound {alone:,.0f} and "
            f"{pair:,.0f} a pair"
        )
        return [*rows, *([] if is_within else ["BEYOND THE BOUND"])]

    def idle_rows(self) -> list[str]:
        """What ticks of idle time take, and the calls of a whole image, and what they may take."""
        alone, block = of_image(self.program, self.source)
        most = 2.0 * BLOCKS_PER_TICK * block + alone
        rows, is_within = [], True
        for number, name in enumerate(WORK):
            took = max(others[f"tick_{number}"][0] for others in self.others)
            is_within &= took <= most
            rows.append(f"a tick that {name}: {took:,} instructions; bound {most:,.0f}")
        for name, times in WHOLE.items():
            calls = [others[f"whole_{name}"] for others in self.others]
            is_within &= all(took <= alone + times * blocks * block for took, blocks in calls)
            took, blocks = max(calls)
            rows.append(
                f"`{name}`, {blocks} blocks: {took:,} instructions; bound {times * block:,.0f} "
                f"a block and {alone:,.0f}"
            )
        return [*rows, *([] if is_within else ["BEYOND THE BOUND: idle work"])]

    def events(self) -> str:
        """Instructions for a step of each event."""
        found = self.bound(Case()).events | {
            event: value
            for event, value in self.bound(Case(has_pairs=True)).events.items()
            if event in ("pair", "third", "mark")
        }
        found |= self.bound(Case(has_votes=True)).events
        found |= self.bound(Case(is_track=True)).events
        found["part"] = self.bound(Case(is_unknown=True)).events["part"]
        return ", ".join(f"{event} {value:,.0f}" for event, value in sorted(found.items()))


def most_of(calls: list[Call]) -> str:
    """The call with the most instructions."""
    if not calls:
        return "none"
    call = max(calls, key=lambda one: one.instructions)
    return f"{call.instructions:,} at {call.steps:,}"


def report(target: Target) -> list[str]:
    """Print what was found of a target; returns what is beyond the bound."""
    beyond = [call for call in target.calls if target.share(call) > 1.0]
    worst = max(target.calls, key=target.share)
    of_image = [*target.image_rows(), *target.idle_rows()]
    for line in [
        f"\n{target.name}\n",
        "| call | frames | worst observed, at steps | worst constructed, at steps "
        "| most of the bound | once | per step | per look-up |",
        "|---|---|---|---|---|---|---|---|",
        *target.rows(),
        "",
        *of_image,
        f"instructions for a step: {target.events()}",
        f"{len(target.calls):,} frames, {len(beyond)} beyond the bound; the nearest is "
        f"{100.0 * target.share(worst):.0f} % of it: {worst.instructions:,} instructions, "
        f"{worst.steps:,} steps, genes {worst.genes}",
    ]:
        print(line)
    found = [f"{target.name}: beyond the bound: {call}" for call in beyond[:5]]
    return found + [line for line in of_image if line.startswith("BEYOND")]


def main() -> int:
    """Print the tables of the targets: NAME TOOLS ELF..., with / between them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("given", nargs="+")
    given = parser.parse_args().given
    source = read_source()
    wrong = check(source)
    for part in " ".join(given).split(" / "):
        name, tools, *elfs = part.split()
        target = Target(name.replace("_", " "), [Path(elf) for elf in elfs], tools, source)
        wrong += report(target)
    print("\n" + ("\n".join(wrong) or "wcet: no call beyond the bound"))
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
