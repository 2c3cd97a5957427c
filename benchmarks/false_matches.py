"""Frames made to mislead the matcher: wrong answers, and how often chance agrees.

    python benchmarks/false_matches.py [--frames 1000] [--kind random dense ...] [--quick]

Every frame is of a kind of ``false_frames.py`` and has a setting of its own: a tolerance or a
noise from 0.05 to 3 px is stated, and the true noise is the stated one, six times it, or a sixth.
All frames go through the C library (``c``) and one in ``--searched`` through numpy, which returns
reasons of refusals and all agreements of its search. ``judging.py`` defines what a wrong answer
is.

The bound says that at most a share p of frames of false spots agree with any attitude so well that
the probability of chance is p or less. The second table and ``--plot`` have that share for frames
without a sky. The null model is spots anywhere on the detector: the kinds ``random`` and ``dense``.
The bound does not hold for the other kinds, whose spots are in clusters, lines or grids: there
only the answers count.

Two databases of the embedded sky are built: ``gaia-12deg`` and `DENSE`, 36,000 stars in fields of
24 deg, 249 to 1,063 of them in a frame. The exit code is 1 if an answer is wrong, or if frames of
the null model agree more often than the bound says.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from false_frames import KINDS, Scene, Trial
from judging import Notable, judge_answer, search
from rows import Options, Rows, ended

from starcat.database.products.table import USUAL_PRODUCTS
from starcat.matcher.matcher import Matcher
from starcat.matcher.settings import CERTAIN
from starcat.pipeline.build import build
from starcat.pipeline.report.plots import STYLE, headline
from starcat.pipeline.simulation.selftest import wilson_interval
from starcat.pipeline.specs.reading import preset, spec_from_dict
from starcat.storage.figures import own_style, write_figure

DENSE = {
    "name": "dense-24deg",
    "version": "1.0.0",
    "epoch_jyear": 2016.0,
    "catalog": {"source": "gaia", "band": "G"},
    "selection": {"faint_limit_mag": 7.5, "doubles": {"min_separation_deg": 0.01}},
    "camera": {"width_px": 1024, "height_px": 1024, "fov_x_deg": 24.0},
    "products": {name: {"enabled": False} for name in USUAL_PRODUCTS if name != "triangles"},
    "self_test": {"frames": 1, "noise_px": 0.05},
}  # fmt: skip
"""A field as dense as TESS's. With 36,000 stars a field has up to 560,000 pairs, too many for a
product of pairs; triangles join the 8 brightest stars of each field."""

VALUES_PX = (0.05, 0.15, 0.5, 1.0, 2.0, 3.0)
"""Stated values of the tolerance or of the noise."""

FACTORS = (1.0, 6.0, 1.0 / 6.0)
"""True noise over the stated one."""

MAX_NOISE_PX = 6.0
"""Largest true noise."""

NOISE_MAG = 0.3
"""Noise of magnitudes, which is stated for a third of the frames that have some."""

FOV_ERROR = 0.02
"""Error of the focal length that is allowed in an eighth of the frames that numpy searches."""

MAX_STEPS = 300_000
"""Steps of a search with numpy."""

PROBABILITIES = tuple(10.0**-n for n in range(1, 10))
"""Probabilities of chance whose frequency is measured."""

WRONG = ("no sky", "attitude", "names")
"""Verdicts of wrong answers."""

BATCH = 200


@dataclass(frozen=True)
class Stated:
    """The errors of centroids as stated to the matcher, and the true errors."""

    name: Literal["tolerance_px", "noise_px"]
    value_px: float
    factor: float

    @property
    def settings(self) -> dict[str, Any]:
        """The settings of a matcher."""
        return {"tolerance_px": None, "noise_px": None, self.name: self.value_px}

    @property
    def noise_px(self) -> float:
        """True noise of a star; that of a tolerance is a third of it."""
        right = self.value_px / (3.0 if self.name == "tolerance_px" else 1.0)
        return min(MAX_NOISE_PX, self.factor * right)


STATED = [
    Stated(name, value, factor)
    for value in VALUES_PX
    for name in ("tolerance_px", "noise_px")
    for factor in FACTORS
]  # fmt: skip


@dataclass
class Counts:
    """The results of the frames of a kind, with one of the matchers."""

    frames: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)  # verdicts, or why there is none
    agreeing: Counter[float] = field(default_factory=Counter)  # frames, by probability of chance
    told: list[dict[str, Any]] = field(default_factory=list)  # frames to inspect

    def add(self, other: Counts) -> None:
        """Add the results of other frames."""
        self.frames += other.frames
        self.outcomes.update(other.outcomes)
        self.agreeing.update(other.agreeing)
        self.told += other.told

    @property
    def wrong(self) -> int:
        """Wrong answers."""
        return sum(self.outcomes[name] for name in WRONG)


@dataclass(frozen=True)
class Job:
    """Some frames of a kind."""

    folders: tuple[Path, Path]  # the matcher's database, and the dense database
    kind: str
    first: int  # seed of the first frame
    count: int
    searched: int  # numpy searches one in this many frames
    is_endless: bool


@lru_cache(maxsize=2)
def matcher_of(folder: Path) -> Matcher:
    """Return the matcher of a database; each process opens its own."""
    return Matcher.open(folder, engine="c")


def run(job: Job) -> dict[str, Counts]:
    """Make, identify and judge the frames of a job, with both matchers."""
    plain, deeper = (matcher_of(folder) for folder in job.folders)
    in_c, in_numpy = Counts(), Counts()
    for seed in range(job.first, job.first + job.count):
        generator = np.random.default_rng([seed, *job.kind.encode()])
        stated = STATED[generator.integers(len(STATED))]
        scene = Scene(plain.database, deeper.database, stated.noise_px)
        trial = KINDS[job.kind](generator, scene)
        is_mag_stated = trial.mag is not None and generator.random() < 1 / 3
        matcher = Matcher(
            plain.database,
            plain.settings,
            **stated.settings,
            noise_mag=NOISE_MAG if is_mag_stated else None,
        )
        facts = {
            "kind": job.kind,
            "seed": seed,
            **asdict(stated),
            "noise_mag": matcher.settings.noise_mag,
        }
        _ask_c(in_c, matcher, trial, scene, facts | {"engine": "c"})
        if seed % job.searched == 0:
            fov_error = FOV_ERROR if (seed // job.searched) % 8 == 7 else 0.0
            facts |= {"engine": "numpy", "fov_error": fov_error}
            answer, notable = search(
                trial, scene, matcher.with_settings(engine="numpy"), fov_error, MAX_STEPS,
                is_endless=job.is_endless,
            )  # fmt: skip
            _count_search(
                in_numpy, answer, notable, trial, scene, matcher.settings.tolerance_px, facts
            )
    return {"c": in_c, "numpy": in_numpy}


def _ask_c(
    counts: Counts, matcher: Matcher, trial: Trial, scene: Scene, facts: dict[str, Any]
) -> None:
    """Ask the C library for an answer that is certain, and how well chance agrees without a sky."""
    counts.frames += 1
    px, mag = trial.centroids_px, trial.mag
    if not trial.attitudes:
        least = _least_chance(matcher, trial)
        _count_agreeing(counts, least)
        if least > CERTAIN:
            counts.outcomes["no_match"] += 1
            return
    answer = matcher.identify(px, mag=mag)
    verdict = judge_answer(answer, trial, scene, matcher.settings.tolerance_px)
    counts.outcomes[verdict or answer.status] += 1
    if verdict not in (None, "right"):
        log10 = math.log10(max(answer.false_match_probability, 1e-300))
        n_matched = int((answer.star_index >= 0).sum())
        one = Notable(verdict, log10, None, n_matched, len(px), None)
        counts.told.append(facts | asdict(one) | {"is_answer": True})


def _least_chance(matcher: Matcher, trial: Trial) -> float:
    """Return the smallest probability of chance of any answer.

    A search ends at a hundredth of the allowed probability. If it did, chance can agree still
    better, and the next search allows less.
    """
    least, allowed = 1.0, PROBABILITIES[0]
    while allowed >= CERTAIN:
        lenient = matcher.with_settings(max_false_match_probability=allowed)
        found = lenient.identify(trial.centroids_px, mag=trial.mag)
        least = min(least, found.false_match_probability if found.ok else 1.0)
        if least > 0.01 * allowed:
            break
        allowed *= 0.01
    return least


def _count_agreeing(counts: Counts, least: float) -> None:
    counts.agreeing.update({p: int(least <= p) for p in PROBABILITIES})


def _count_search(
    counts: Counts, answer: Any, notable: Sequence[Notable], trial: Trial, scene: Scene,
    tolerance_px: float, facts: dict[str, Any],
) -> None:  # fmt: skip
    counts.frames += 1
    verdict = judge_answer(answer, trial, scene, tolerance_px)
    why = "none" if answer.refusal is None else answer.refusal.reason
    counts.outcomes[verdict or why] += 1
    if not trial.attitudes:
        _count_agreeing(counts, min((10.0**one.log10_chance for one in notable), default=1.0))
    for one in notable:
        if one.verdict != "right":
            is_answer = verdict == one.verdict and one.withheld is None
            counts.told.append(facts | asdict(one) | {"is_answer": is_answer})


def databases(folder: Path) -> dict[str, Path]:
    """Build both databases of the embedded sky, unless they are there."""
    specs = preset("gaia-12deg"), spec_from_dict(DENSE, "false_matches.py")
    places = {spec.name: folder / f"{spec.name}-{spec.version}" for spec in specs}
    for spec in specs:
        if not places[spec.name].exists():
            build(spec, folder, workers=1)
    return places


ON_DENSE = ("random", "dense", "clustered", "on_a_grid", "scaled", "overlaid", "few_true_stars")
"""Kinds that are identified with the dense database, with a tenth of the frames."""


def jobs(
    folders: dict[str, Path], kinds: Sequence[str], frames: int, searched: int, is_endless: bool
) -> Iterator[tuple[str, Job]]:
    """Yield the jobs, each with the name of its row."""
    plain, dense = folders["gaia-12deg"], folders["dense-24deg"]
    for kind in kinds:
        rows = [(kind, (plain, dense), frames)]
        if kind in ON_DENSE:
            rows.append((f"{kind}, 24 deg", (dense, dense), max(1, frames // 10)))
        for row, pair, count in rows:
            for first in range(0, count, BATCH):
                size = min(BATCH, count - first)
                yield row, Job(pair, kind, first, size, searched, is_endless)


Found = dict[tuple[str, str], Counts]
"""Counts by row and engine."""


def measure(asked: argparse.Namespace, folder: Path) -> Found:
    """Run all jobs; whether they run side by side does not change the counts."""
    found: Found = {}
    todo = list(jobs(databases(folder), asked.kind, asked.frames, asked.searched, asked.all))
    with ProcessPoolExecutor(asked.workers) as pool:
        for (row, _), counted in zip(todo, pool.map(run, [job for _, job in todo]), strict=True):
            for engine, counts in counted.items():
                found.setdefault((row, engine), Counts()).add(counts)
    return {key: counts for key, counts in found.items() if counts.frames}


def is_null_model(row: str) -> bool:
    """Return whether the spots of a row are anywhere on the detector."""
    return row.split(",")[0] in ("random", "dense")


def too_often(found: Found) -> Iterator[str]:
    """Yield where chance agrees more often than its bound: the 95 % interval begins above it."""
    for (row, engine), counts in found.items():
        for probability, hits in counts.agreeing.items():
            least, _ = wilson_interval(hits, counts.frames)
            if is_null_model(row) and least > probability:
                yield f"{row}, {engine}: {hits} of {counts.frames} agree at {probability:g}"


def print_tables(found: Found) -> None:
    """Print the results of the frames, the wrong answers, and how often chance agrees."""
    print(f"{'kind':<31}{'engine':<7}{'frames':>8}{'right':>8}{'wrong':>7}  no answer")
    for (row, engine), counts in found.items():
        why = {k: n for k, n in counts.outcomes.items() if k not in ("right", *WRONG) and n}
        words = ", ".join(f"{name} {n:,}" for name, n in sorted(why.items()))
        right = counts.outcomes["right"]
        print(f"{row:<31}{engine:<7}{counts.frames:>8,}{right:>8,}{counts.wrong:>7,}  {words}")
    print("\nFrames without a sky of which chance agrees at p or less")
    print(f"{'kind':<31}{'engine':<7}{'frames':>8}", *(f"{p:>7.0e}" for p in PROBABILITIES))
    for (row, engine), counts in found.items():
        if counts.agreeing:
            hits = (f"{counts.agreeing[p]:>7,}" for p in PROBABILITIES)
            print(f"{row:<31}{engine:<7}{counts.frames:>8,}", *hits)
    print("\nAgreements that are false and of chance below 1e-5, and all wrong answers")
    keys = ("verdict", "log10_chance", "share", "n_matched", "n_spots", "withheld", "name",
            "value_px", "factor", "fov_error", "seed", "is_answer")  # fmt: skip
    print(f"{'kind':<31}", *keys)
    for (row, engine), counts in found.items():
        for one in sorted(counts.told, key=lambda told: told["log10_chance"]):
            if one["is_answer"] or one["log10_chance"] < -5.0:
                print(f"{row:<31}", engine, *(_short(one.get(key)) for key in keys))


def _short(value: object) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def draw(found: Found, path: Path) -> None:
    """Draw the share of frames in which chance agrees at p or less, against p."""
    from matplotlib.figure import Figure

    colours = ("#2c6e9e", "#d1495b", "#3f8f5b", "#8a5fa8", "#c98a1b", "#4fb0ae", "#7a5230")
    with own_style(STYLE):
        figure = Figure(figsize=(7.2, 4.6))
        headline(
            figure,
            "How often false spots agree with an attitude, against the bound",
            "Frames without a sky; all agreements of the search, whatever share they explain",
        )
        axes = figure.add_axes((0.1, 0.13, 0.6, 0.7))
        ends = PROBABILITIES[-1], PROBABILITIES[0]
        axes.loglog(ends, ends, color="#555", lw=1.0, label="the bound")
        rows = [(row, counts) for (row, engine), counts in found.items() if counts.agreeing
                and engine == "numpy"]  # fmt: skip
        for number, (row, counts) in enumerate(rows):
            style = {"color": colours[number % len(colours)], "ls": "-" if number < 7 else "--"}
            p = [p for p in PROBABILITIES if counts.agreeing[p]]
            shares = [counts.agreeing[one] / counts.frames for one in p]
            label = f"{row.replace('_', ' ')} ({counts.frames:,})"
            axes.loglog(p, shares, marker="o", ms=3.5, lw=1.2, label=label, **style)
        axes.set_xlabel("bound on the probability of chance, p")
        axes.set_ylabel("share of frames that agree at p or less")
        figure.legend(loc="center left", bbox_to_anchor=(0.71, 0.5), frameon=False, fontsize=7.5)
        write_figure(figure, path)


def main(rows: Rows) -> None:
    """Measure, print, draw."""
    options = Options(__doc__)
    options.size("--frames", 1000, 10, "of each kind")
    options.size("--searched", 20, 10, "numpy searches one in this many")
    options.add_argument("--kind", nargs="+", choices=KINDS, default=list(KINDS))
    options.add_argument("--all", action="store_true", help="numpy searches on after its answer")
    options.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    options.add_argument("--folder", type=Path, help="where the databases are, or will be")
    options.add_argument("--json", type=Path, metavar="FILE")
    options.add_argument("--plot", type=Path, metavar="FILE", help="SVG or PNG")
    asked = options.asked()
    with tempfile.TemporaryDirectory() as scratch:
        found = measure(asked, asked.folder or Path(scratch))
    print_tables(found)
    if asked.json:
        content = {f"{row}, {engine}": vars(counts) for (row, engine), counts in found.items()}
        asked.json.write_text(json.dumps(content, indent=1) + "\n")
    if asked.plot:
        draw(found, asked.plot)
    for (row, engine), counts in found.items():
        rows.expect(not counts.wrong, f"{row}, {engine}: {counts.wrong} wrong answers")
    above = list(too_often(found))
    rows.failed.extend(above)
    wrong = sum(counts.wrong for counts in found.values())
    print(f"\n{wrong} wrong answers in {sum(c.frames for c in found.values()):,} frames")
    print("" if above else "chance agrees no more often than the bound says")


if __name__ == "__main__":
    ended(main)
