# SPDX-License-Identifier: MIT
"""The most instructions that a call may take, of a compiled program and the table of loops.

Every instruction of the library is attributed, by the debug information and through what was
inlined, to a line of the source, and so to how often loops.txt lets that run in an event. The bound
is the largest sum over an event for one of its steps, and what a call does without steps:

    instructions <= once + per_step * steps + per_look_up * min(steps, 5000)

With a table of neighbours, 10,000 takes the place of 5,000, as triangles may be searched twice.
"""

from __future__ import annotations

import itertools
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from types import CodeType

from loops import Loop, Source, rows_of
from machine import COPIES, LARGEST_COPY, Place, Program, machine_loops

N, S = 64, 192  # STARCAT_MAX_CENTROIDS, STARCAT_MAX_STARS
BANDS = 64  # bands of the image; a wider grid makes the bound larger
C = min(N, 32)
LIMITS = {"C": C, "P": C * (C - 1) // 2, "X": min(N, 400), "K": 50, "V": 32, "max": max}
MOST_LOOK_UPS = 5000  # limit of one search by triangles
MOST_SHAPED = 80  # triangles that are looked up in frames of another shape, of the effort for them
MOST_LEADERS = 192
GROUP = 64  # stars whose votes are counted together
FEW_VOTERS = (1, 2, 3, 4, 8, 16, C)
MOST_MODELS = 5  # more fits per try, if four matched, with shapes
SHAPES = ("model", "shape", "faces", "determine")
VERIFY = ("band", "star", "try", "iteration", "bound", "less", *SHAPES)
VOTES = ("group",)
IDENTIFY = (*VERIFY, "take", "part", "block_of_rows", "sides", "pair", "third", "mark", *VOTES)
TRACK = (*VERIFY, "predict", "next", "two")
PAID_LATER = ("take", "look_up", "third", "star", "try", "predict", "two", "runs")
ROOTS = (
    "starcat_identify_frame",
    "starcat_track_frame",
    "starcat_fit_attitude",
    "starcat_open_image",
    "starcat_scrub_image",
    "starcat_list_neighbours",
)
Form = Counter[tuple[str, str]]
"""How often something runs: a sum of expressions of events."""

Copies = dict[object, dict[object, Form]]

SCALES = ("bound_shape", "fit_scale", "is_similar", "look_up_similar")
CROWDED = (
    "search_by_neighbours",
    "list_neighbours",
    "is_earlier",
    "starcat_measure_side>starcat_angle_of_chord",
)
LENS = ("undistort_point", "distort_point", "differentiate_distortion", "apply_distortion")
LONGEST = ("search_by_longest_side", "search_with_longest_side", "sift_heap")
MAGNITUDES = ("sum_polynomials", "count_compatible")
VOTING = (
    "starcat_count_references",
    "starcat_find_least_matches",
    "starcat_search_votes",
    "list_voters",
    "keep_group",
    "find_runs",
    "count_group",
    "bound_weight",
    "find_enough",
    "count_votes",
    "keep_star",
    "try_star",
    "list_votes",
)
TRIANGLES = (
    "starcat_look_up_triangle",
    "look_up_features",
    "look_up_similar",
    "compare_feature",
    "try_order",
    "starcat_search_shaped",
    "look_up_shaped",
    "look_up_as",
    "find_linear_shape",
    "starcat_try_shape",
)


@dataclass(frozen=True)
class Case:
    """What a call is of; functions of other cases do not run."""

    is_track: bool = False
    has_pairs: bool = False
    is_crowded: bool = False
    is_unknown: bool = False
    has_lens: bool = False
    has_magnitudes: bool = True
    has_votes: bool = False

    @property
    def root(self) -> str:
        """The function that is called."""
        return ROOTS[self.is_track]

    @property
    def longest(self) -> int:
        """Searches by the longest side; frames of another shape have one, with triangles."""
        plain = not (self.has_magnitudes or self.is_crowded)
        return 0 if self.is_track else int(plain) + int(not self.has_pairs)

    def excluded(self) -> set[str]:
        """Functions, or one inlined in another, that do not run."""
        left_out: set[str] = set(TRIANGLES if self.has_pairs else ("starcat_look_up_pyramid",))
        left_out |= set() if self.is_crowded else set(CROWDED)
        left_out |= set() if self.has_magnitudes else {"search_by_brightness", *MAGNITUDES}
        left_out |= set() if self.longest else set(LONGEST)
        left_out |= set() if self.has_votes else set(VOTING)
        left_out |= {"is_same"} if self.is_unknown else set(SCALES)
        return left_out | (set() if self.has_lens else set(LENS))


def parse(counts: str) -> Form:
    """Events and expressions of a cell: "try 3; iteration 4*matched"; "-" is in no event."""
    if counts == "-":
        return Form()
    parts = (part.strip().split(" ", 1) for part in counts.split(";"))
    return Form((event, expression) for event, expression in parts)


class Counts:
    """How often lines and functions run in a call."""

    def __init__(self, program: Program, source: Source, root: str, excluded: set[str], *,
                 is_unknown: bool = False, has_votes: bool = False,
                 longest: int = 1) -> None:  # fmt: skip
        self.program, self.excluded, self.root = program, excluded, root
        self.loops: dict[tuple[str, str], list[Loop]] = defaultdict(list)
        for loop in source.loops:
            counts = loop.counts.replace("votes", str(int(has_votes)))
            counts = counts.replace("longest", str(longest))
            self.loops[loop.file, loop.function].append(replace(loop, counts=counts))
        self.stated = {
            (file, name): parse(
                runs.replace("unknown", str(int(is_unknown))).replace("votes", str(int(has_votes)))
            )
            for file, name, runs in rows_of("Functions")
        }
        self.callers: dict[str, list[tuple[str, int]]] = defaultdict(list)
        for name, body in program.functions.items():
            for k, one in enumerate(body):
                callee = program.callee(name, one)
                if callee is not None and one.places:
                    self.callers[callee].append((name, k))
        self._of_symbol: dict[str, Form] = {}
        self._of_places: dict[tuple[tuple[Place, ...], str, int], Form] = {}
        self.present: set[tuple[object, ...]] = set()
        self.machine: dict[str, list[tuple[int, int, set[int]]]] = {}
        self._find_present()

    def _find_present(self) -> None:
        """Find which loops of the source are loops of the machine; others were unrolled."""
        for name, body in self.program.functions.items():
            if any(one.places for one in body):
                found = [loop for loop in machine_loops(body) if body[loop[0]].places]
                self.machine[name] = found
                for last, depth, _ in found:
                    chain = self.chain(body[last].places, name)
                    self.present.update(chain[max(min(depth, len(chain)) - 1, 0) :])

    def around(self, place: Place) -> list[Loop]:
        """The loops of its function that a line is in, the outermost first."""
        file, name, line = place
        return [one for one in self.loops[file, name] if one.first <= line <= one.last]

    def is_head(self, place: Place) -> bool:
        """Whether a line is the head of a loop."""
        return any(loop.first <= place[2] < loop.body for loop in self.around(place))

    def chain(self, places: tuple[Place, ...], function: str) -> list[tuple[object, ...]]:
        """The loops around an instruction, the outermost first."""
        return [
            (function, places[k + 1 :], loop.file, loop.first)
            for k in range(len(places) - 1, -1, -1)
            for loop in self.around(places[k])
        ]

    def depth(self, places: tuple[Place, ...], function: str) -> int:
        """How many loops of the machine an instruction is in."""
        return sum(one in self.present for one in self.chain(places, function))

    def of_function(self, place: Place) -> Form | None:
        """What loops.txt states for a function, if it does."""
        if place[1] in ROOTS and place[1] != self.root:
            return Form()
        return self.stated.get(place[:2])

    def of_places(self, places: tuple[Place, ...], function: str, most: int = 99) -> Form:
        """Runs of an instruction, within no more than `most` of the loops around it."""
        key = (places, function, most)
        if key not in self._of_places:
            self._of_places[key] = self._runs(places, function, most)
        return self._of_places[key]

    def _runs(self, places: tuple[Place, ...], function: str, most: int) -> Form:
        names = [name for _, name, _ in places]
        if self.excluded & {*names, *(f"{b}>{a}" for a, b in itertools.pairwise(names))}:
            return Form()
        runs = self.of_symbol(function)
        for k in range(len(places) - 1, -1, -1):
            stated = self.of_function(places[k])
            runs = runs if stated is None else stated
            for loop in self.around(places[k]):
                if most == 0:
                    return runs
                is_there = (function, places[k + 1 :], loop.file, loop.first) in self.present
                most -= is_there
                inner = of_body(loop, runs, is_there)
                # The head runs once more than the body.
                is_head = is_there and k == 0 and places[k][2] < loop.body
                runs = runs + inner if is_head else inner
        return runs

    def of_symbol(self, function: str) -> Form:
        """Runs of a function of the program, by its callers."""
        if function not in self._of_symbol:
            self._of_symbol[function] = Form()
            copies: Copies = defaultdict(lambda: defaultdict(Form))
            for owner, k in self.callers[function]:
                places = self.program.functions[owner][k].places
                stated, copy = self._copy_of(places, owner)
                copies[stated][copy].update(self.of_places(places, owner))
            self._of_symbol[function] = largest(copies)
        return self._of_symbol[function]

    def _copy_of(self, places: tuple[Place, ...], function: str) -> tuple[object, object]:
        """The innermost stated function around an instruction, and which copy of it."""
        for k, place in enumerate(places):
            if self.of_function(place) is not None:
                return place[:2], (function, places[k + 1 :])
        return None, None

    def costs(self) -> Form:
        """Instructions by event and expression; libm counts at the lines that call it."""
        copies: Copies = defaultdict(lambda: defaultdict(Form))
        for name, body in self.program.functions.items():
            for k, runs in enumerate(self.of_body(name)):
                if runs:
                    stated, copy = self._copy_of(body[k].places, name)
                    size = 1 + self.program.of_call(name, k)
                    copies[stated][copy].update({key: size * n for key, n in runs.items()})
        return largest(copies)

    def of_body(self, name: str) -> list[Form]:
        """Number of runs of each instruction of a function.

        An instruction runs as often as its line, and at least as often as the loop of the machine
        code that contains it, because compilers can move it there.
        """
        body, result = self.program.functions[name], []
        for one in body:
            callee = self.program.callee(name, one) or ""
            # A loop may have become the call that sets its memory.
            most = self.depth(one.places, name) if COPIES.search(callee) else 99
            result.append(self.of_places(one.places, name, most) if one.places else Form())
        for last, depth, nodes in self.machine.get(name, []):
            runs = self.of_places(body[last].places, name, depth)
            is_one_line = len({body[k].places for k in nodes}) == 1
            is_own = self.is_head(body[last].places[0])
            if is_one_line and not is_own and depth > len(self.chain(body[last].places, name)):
                # A loop that the source has not: the compiler's copy of a structure, by words.
                runs = times(runs, str(LARGEST_COPY // 4))
            for k in nodes:
                places = body[k].places
                # What a function does that has runs of its own is stated there.
                is_plain = all(self.of_function(place) is None for place in places[:-1])
                if places and is_plain and self.depth(places, name) < depth:
                    result[k] = result[k] | runs
        return result


def of_body(loop: Loop, runs: Form, is_there: bool) -> Form:
    """Number of runs of the body of a loop, from the runs of the code around it."""
    if not loop.counts.startswith("x "):
        return parse(loop.counts)
    factor = loop.counts[2:]
    if factor.isdigit() and not is_there:
        return runs  # unrolled: each run has instructions of its own
    return times(runs, factor)


def times(runs: Form, factor: str) -> Form:
    """So many for each run."""
    return Form({(event, f"({text})*({factor})"): n for (event, text), n in runs.items()})


def largest(copies: Copies) -> Form:
    """Sum what runs; of a function that was inlined in several places, the largest copy."""
    found = Form()
    for stated, forms in copies.items():
        most = Form()
        for form in forms.values():
            most = most | form if stated else most + form
        found += most
    return found


@cache
def compiled(text: str) -> CodeType:
    """Compile an expression of loops.txt."""
    return compile(text, "loops.txt", "eval")


def total(costs: Form, event: str, **values: float) -> float:
    """Instructions of one event."""
    names = {**LIMITS, "most": min(values.get("n", N), values.get("within", S)), "n": N, **values}
    return sum(
        count * float(eval(compiled(text), {"__builtins__": {}}, names))
        for (of, text), count in costs.items()
        if of == event
    )


def fits() -> Iterator[dict[str, int]]:
    """What a fit may find: the ends of the ranges and some between."""
    stars = (0, 1, 4, 5, 8, 16, 32, 64, 128, S)
    for n, near, within in itertools.product((4, 5, 8, 16, 33, N), stars, stars):
        if within <= near:
            for matched in {0, 4, 5, 8, max(min(n, within), 4)}:
                if matched <= min(n, within):
                    yield {"n": n, "near": near, "within": within, "matched": matched}


def of_fits(costs: Form, has_magnitudes: bool) -> dict[str, float]:
    """The most instructions per step in the verification of an attitude."""
    one = {event: total(costs, event) for event in ("band", "star")}
    worst: dict[str, float] = defaultdict(float)

    def found(event: str, instructions: float, steps: int) -> None:
        worst[event] = max(worst[event], instructions / steps)

    for n in range(4, N + 1):
        found("model", total(costs, "model", n=n), 64 + 16 * n)
        found("shape", total(costs, "shape", n=n), 64 + 16 * n)
        found("faces", total(costs, "faces", n=n), 3072)
        found("determine", total(costs, "determine", n=n), 512 + 64 * n)
    tries, models = [], []
    for v in fits():
        n, near, within, matched = v["n"], v["near"], v["within"], v["matched"]
        steps = near + n * (within + 1) + 16 * matched
        cost = total(costs, "iteration", **v)
        found("iteration", cost, steps)
        steps += 1 + near
        cost += total(costs, "fit", **v) + one["band"] + near * one["star"]
        models.append((cost + total(costs, "model", n=n), steps + 64 + 16 * n))
        cost, steps = cost + total(costs, "try", **v), steps + 32
        if matched >= 4:
            paid = 16 * (n + within)
            paid += (n * within + min(n, within) ** 2) * has_magnitudes
            bound = total(costs, "bound", **v)
            found("bound", bound, paid)
            found("less", total(costs, "less", **v), 16 * (n + within))
            tries.append((cost + bound, steps + paid, 1))
        else:
            tries.append((cost, steps, 0))
    low, high = 0.0, 1e6
    while high - low > 0.5:  # the least that pays for every try with its other fits
        each = 0.5 * (low + high)
        other = MOST_MODELS * max(0.0, *(cost - each * steps for cost, steps in models))
        is_paid = all(cost + n * other <= each * steps for cost, steps, n in tries)
        low, high = (low, each) if is_paid else (each, high)
    worst["try"] = high
    return worst


def per_step(costs: Form, has_magnitudes: bool) -> dict[str, float]:
    """The most instructions for a step of each event."""
    worst = {event: total(costs, event) for event in ("take", "part", "pair", "band", "star")}
    band, star = worst["band"], worst["star"]
    worst["sides"] = total(costs, "sides") / 6.0
    worst["mark"] = max(total(costs, "mark", pairs=p) / (p + 1024.0) for p in (0, 10**9))
    worst["block_of_rows"] = max(
        total(costs, "block_of_rows", rows=rows) / rows for rows in (1, 31, 32)
    )
    of_candidate = star + total(costs, "candidate")
    of_third = total(costs, "third") + band
    worst["third"] = max((of_third + c * of_candidate) / (17.0 + c) for c in range(9))
    for k in (0, 1, S):
        onward, two = total(costs, "next", within=k), total(costs, "two", within=k)
        predicted = total(costs, "predict", near=k) + band + k * star
        steps = k + 1.0
        if k > 0:
            worst["two"] = max(worst.get("two", 0.0), (onward + two) / (2.0 * steps))
        worst["next"] = max(worst.get("next", 0.0), onward / steps)
        worst["predict"] = max(
            worst.get("predict", 0.0), (predicted + onward) / (steps + 1.0 + 2.0 * k)
        )
    return worst | of_votes(costs) | of_fits(costs, has_magnitudes)


def of_votes(costs: Form) -> dict[str, float]:
    """The most instructions for a step of what votes.

    A group pays for its votes once, and each of its stars that is counted again for what is left.
    """
    worst: dict[str, float] = defaultdict(float)
    for voters, run, again in itertools.product((0, *FEW_VOTERS), (0, 1, 10**9), (0, 1, GROUP)):
        values = {"voters": voters, "run": run}
        group = total(costs, "runs", **values) + total(costs, "group", **values)
        counted = group + again * total(costs, "ballot", **values)
        steps = 256 + 32 * voters + run + again * (512 + run // 8)
        worst["group"] = max(worst["group"], counted / steps)
    return worst


def of_leaders(costs: Form, each: float) -> float:
    """Instructions of all leaders of a call that their steps do not pay, at `each` for a step.

    They are few, and their pairs are compared with each other, however few stars are around.
    """
    most = 0.0
    for voters, near in itertools.product(FEW_VOTERS, (1, 2, 3, 5, 9, 17, 33, S)):
        pairs = min(C, (near - 1) * voters)  # the star in the middle votes for nothing
        leader = total(costs, "leader", near=near, voters=voters, pairs=pairs)
        most = max(most, leader - each * near * (voters + 1))
    return MOST_LEADERS * most


def once(costs: Form) -> float:
    """Instructions of a call without steps.

    Those include what it may have begun when the steps were used up: the largest event of each
    kind whose steps are not taken before it, and ten fits that find nothing more to do.
    """
    most = {"n": N, "near": S, "within": S, "matched": min(N, S), "before": N - 1, "rows": 32,
            "voters": C, "stars": 0}  # fmt: skip
    unpaid = sum(total(costs, event, **most) for event in PAID_LATER)
    unpaid += 8 * total(costs, "candidate")
    unpaid += 10 * (total(costs, "fit", **most) + BANDS * total(costs, "band"))
    return total(costs, "once") + unpaid


@dataclass(frozen=True)
class Bound:
    """The most instructions of a call."""

    once: float
    per_step: float
    per_look_up: float
    events: dict[str, float]
    searches: int = 1  # searches by triangles; with votes another one can follow

    def of(self, steps: int) -> float:
        """Instructions for this many steps."""
        return (
            self.once
            + self.per_step * steps
            + self.per_look_up * min(steps, MOST_LOOK_UPS * self.searches)
        )


def bound_of(program: Program, source: Source, case: Case) -> Bound:
    """Find the bound of calls of a case, whether magnitudes have a stated noise or not."""
    events: dict[str, float] = defaultdict(float)
    at_once = of_look_up = 0.0
    every: list[Form] = []
    searches = 1 + case.has_votes
    for without in ((), MAGNITUDES) if case.has_magnitudes else (MAGNITUDES,):
        excluded = case.excluded() | set(without)
        counts = Counts(program, source, case.root, excluded, is_unknown=case.is_unknown,
                        has_votes=case.has_votes, longest=case.longest)  # fmt: skip
        costs = counts.costs()
        every.append(costs)
        at_once = max(at_once, searches * once(costs))
        of_look_up = 0.0 if case.is_track else max(of_look_up, total(costs, "look_up"))
        for event, value in per_step(costs, not without).items():
            events[event] = max(events[event], value)
    events = {event: events[event] for event in (TRACK if case.is_track else IDENTIFY)}
    each = max(events.values())
    at_once += max(of_leaders(costs, each) for costs in every)
    at_once += 0.0 if case.has_pairs else MOST_SHAPED * of_look_up
    return Bound(at_once, each, of_look_up, dict(events), searches)


def of_image(program: Program, source: Source) -> tuple[float, float]:
    """Instructions of starcat_open_image without its blocks, and instructions per block."""
    costs = Counts(program, source, "starcat_open_image", set()).costs()
    return total(costs, "open"), total(costs, "block")


def of_attitude(program: Program, source: Source) -> tuple[float, float]:
    """Instructions of starcat_fit_attitude without its pairs, and instructions per pair."""
    costs = Counts(program, source, "starcat_fit_attitude", set()).costs()
    alone = total(costs, "attitude", given=0)
    return alone, total(costs, "attitude", given=1) - alone
