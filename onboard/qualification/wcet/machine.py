# SPDX-License-Identifier: MIT
"""A compiled program: its instructions, the lines of the source they are of, and its loops.

objdump and addr2line of the target read it.
"""

from __future__ import annotations

import re
import subprocess
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

Place = tuple[str, str, int]
"""File, function and line."""

CALLS = ("bl", "blx", "jal", "jalr", "call")
JUMPS = ("b.n", "b.w", "b", "bx", "j", "jr", "ret", "tail")
BRANCH = re.compile(r"b|cb|j|call|tail")
UNREACHED = re.compile(r"__kernel_rem_pio2|__math_|errno|with_errno|exit|abort")
"""Of libm: angles beyond 800,000 rad, and errors. The library calls for neither."""

COPIES = re.compile(r"memcpy|memset|memmove")
LARGEST_COPY = 500
"""Bytes of a copy whose size is not a constant; no structure is larger."""


@dataclass
class Instruction:
    """An instruction, and its possible successors."""

    address: int
    name: str
    text: str
    target: int | None = None
    places: tuple[Place, ...] = ()  # its line, then the lines that it was inlined at

    @property
    def is_call(self) -> bool:
        """Whether the next instruction comes after what it jumps to."""
        return self.name in CALLS

    @property
    def is_last(self) -> bool:
        """Whether the next instruction does not come after it."""
        returns = self.name.startswith(("pop", "ldm")) and re.search(r"\bpc\b", self.text)
        return self.name in JUMPS or bool(returns)


class Program:
    """The functions of an ELF file."""

    def __init__(self, elf: Path, tools: str, files: set[str]) -> None:
        self.functions: dict[str, list[Instruction]] = {}
        self.name_at: dict[int, str] = {}
        self._longest: dict[str, int] = {}
        self._read(run(tools + "objdump", "-d", "--no-show-raw-insn", str(elf)))
        every = [one for body in self.functions.values() for one in body]
        addresses = "\n".join(f"{one.address:#x}" for one in every)
        self._locate(run(tools + "addr2line", "-a", "-i", "-f", "-e", str(elf), given=addresses),
                     every, files)  # fmt: skip

    def _read(self, said: str) -> None:
        current: list[Instruction] = []
        for line in said.splitlines():
            if head := re.match(r"([0-9a-f]+) <(.+)>:$", line):
                current = self.functions.setdefault(head[2], [])
                self.name_at[int(head[1], 16)] = head[2]
            elif body := re.match(r"\s*([0-9a-f]+):\s+([a-z][\w.]*)\s*(.*)", line):
                one = Instruction(int(body[1], 16), body[2], re.split(r";| # ", body[3])[0])
                to = re.search(r"\b([0-9a-f]+) <", one.text)
                if to and BRANCH.match(one.name):
                    one.target = int(to[1], 16)
                current.append(one)

    @staticmethod
    def _locate(said: str, every: list[Instruction], files: set[str]) -> None:
        at, name = -1, ""
        for line in said.splitlines():
            place = re.match(r"(.*):(\d+|\?)(?: |$)", line)
            if line.startswith("0x"):
                at += 1
            elif place is None:
                name = re.sub(r"_\d+_\d+_(double|float)$", "", line)
            elif Path(place[1]).name in files and place[2] != "?":
                every[at].places += ((Path(place[1]).name, name, int(place[2])),)

    def callee(self, function: str, one: Instruction) -> str | None:
        """The other function that an instruction goes on to, if it does."""
        name = self.name_at.get(one.target) if one.target is not None else None
        return None if name == function else name

    def of_call(self, function: str, k: int) -> int:
        """Instructions of a function of another library that an instruction calls."""
        body = self.functions[function]
        name = self.callee(function, body[k])
        if name is None or self.functions[name][0].places:
            return 0
        if not COPIES.search(name):
            return self.longest(name)
        size = LARGEST_COPY
        for one in body[max(k - 12, 0) : k]:
            if given := re.match(r"(?:r2, #|a2,)(\d+)$", one.text):
                size = int(given[1])
        return 80 + size  # two for each word, and a start

    def longest(self, function: str) -> int:
        """Instructions along the longest path through a function of another library.

        If the function has a loop: the sum of all its instructions.
        """
        if function not in self._longest:
            body = self.functions[function]
            size = [1] * len(body)
            for k, one in enumerate(body):
                callee = self.callee(function, one)
                if callee is not None and not UNREACHED.search(callee):
                    size[k] += self.longest(callee)
            ways = successors(body)
            order = backwards(ways)
            place = {k: at for at, k in enumerate(order)}
            most = [0] * len(body)
            for k in order:
                most[k] = size[k] + max((most[to] for to in ways[k]), default=0)
            has_loop = any(place[to] >= place[k] for k in order for to in ways[k])
            self._longest[function] = sum(size) if has_loop else most[0]
        return self._longest[function]


def run(*command: str, given: str | None = None) -> str:
    """Run a program; returns what it says."""
    return subprocess.run(command, input=given, capture_output=True, text=True, check=True).stdout


def successors(body: list[Instruction]) -> list[list[int]]:
    """Possible successors of each instruction, within its function."""
    at = {one.address: k for k, one in enumerate(body)}
    ways = []
    for k, one in enumerate(body):
        jump = at.get(one.target) if one.target is not None and not one.is_call else None
        onward = [k + 1] if k + 1 < len(body) and not one.is_last else []
        ways.append(onward + ([jump] if jump is not None else []))
    return ways


def backwards(ways: list[list[int]]) -> list[int]:
    """Reached instructions in reverse order: successors come first, except in a loop."""
    order: list[int] = []
    seen, stack = {0}, [(0, iter(ways[0]))]
    while stack:
        node, left = stack[-1]
        onward = next((k for k in left if k not in seen), None)
        if onward is None:
            order.append(node)
            stack.pop()
        else:
            seen.add(onward)
            stack.append((onward, iter(ways[onward])))
    return order


def dominators(ways: list[list[int]], order: list[int]) -> dict[int, int]:
    """Immediate dominator of each instruction (Cooper et al. 2001)."""
    place = {node: k for k, node in enumerate(order)}
    before: dict[int, list[int]] = defaultdict(list)
    for node in order:
        for onward in ways[node]:
            before[onward].append(node)
    above, changed = {0: 0}, True
    while changed:
        changed = False
        for node in reversed(order[:-1]):
            known = [k for k in before[node] if k in above]
            best = known[0]
            for one in known[1:]:
                other = one
                while best != other:
                    if place[best] < place[other]:
                        best = above[best]
                    else:
                        other = above[other]
            if above.get(node) != best:
                above[node], changed = best, True
    return above


def machine_loops(body: list[Instruction]) -> list[tuple[int, int, set[int]]]:
    """Natural loops of a function: last branch of each, its depth, and the instructions in it."""
    ways = successors(body)
    order = backwards(ways)
    above = dominators(ways, order)
    before: dict[int, list[int]] = defaultdict(list)
    for node in order:
        for onward in ways[node]:
            before[onward].append(node)
    inside: dict[int, set[int]] = {}
    last: dict[int, int] = {}
    for node in order:
        for head in ways[node]:
            one = node
            while one not in (head, 0):
                one = above[one]
            if one != head:
                continue
            nodes, todo = inside.setdefault(head, {head}), [node]
            last[head] = max(node, last.get(head, node))
            while todo:
                one = todo.pop()
                if one not in nodes:
                    nodes.add(one)
                    todo += before[one]
    return [
        (last[head], sum(head in others for others in inside.values()), nodes)
        for head, nodes in inside.items()
    ]
