"""The work of ``starcat evaluate``: databases, experiments, report.

An output folder holds ``artifacts/``, ``records/`` with a Parquet file for each experiment, and a
folder for each report, named after the papers or the database. Sweeps of one database into the same
folder stand beside each other; a point that is measured again takes the place of the old one, as
its record does.
"""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from starcat import build
from starcat.database import read_manifest
from starcat.errors import ConfigError
from starcat.pipeline import Inputs
from starcat.pipeline.specs import preset
from starcat.progress import Progress, no_progress
from starcat.version import __version__
from starcat_lab.campaign import run_paper
from starcat_lab.experiment import Paper, code_sha256
from starcat_lab.papers import s1, s2, s3, s4, s5
from starcat_lab.report.files import RESULTS, write_evaluation
from starcat_lab.sweep import Sweep, sweep_paper

PAPERS: dict[str, Paper] = {
    paper.name: paper for paper in (s1.PAPER, s2.PAPER, s3.PAPER, s4.PAPER, s5.PAPER)
}
"""``S1`` to ``S5``, each from its own module of ``starcat_lab.papers``."""


def papers_named(name: str) -> list[Paper]:
    """Return the papers that a user asks for."""
    if name.lower() == "all":
        return [PAPERS[paper_name] for paper_name in sorted(PAPERS)]
    try:
        return [PAPERS[name.upper()]]
    except KeyError:
        choices = ", ".join([*sorted(PAPERS), "all"])
        raise ConfigError(
            f"paper {name!r} is unknown", value=name, hint=f"choose one of {choices}"
        ) from None


@dataclass(frozen=True)
class Evaluation:
    """The measured results, and the path of their report."""

    contents: tuple[dict[str, Any], ...]  # `Outcome.as_dict` of each paper or sweep
    page: Path  # the report, ``index.html``, next to its tables and curves


def prepare_databases(
    presets: Iterable[str],
    inputs: Inputs,
    folder: Path,
    *,
    workers: int = 2,
    progress: Progress = no_progress,
) -> dict[str, Path]:
    """Build the databases that papers need."""
    databases = {}
    for name in dict.fromkeys(presets):

        def forward(stage: str, done: int, total: int | None, name: str = name) -> None:
            progress(f"build {name}", done, total)

        spec = preset(name)
        files = {source: paths for source, paths in inputs.items() if source in spec.sources}
        built = build(spec, folder, inputs=files, replace=True, workers=workers, progress=forward)
        databases[name] = built.folder
    return databases


def evaluate_papers(
    name: str,
    inputs: Inputs,
    output: Path,
    *,
    quick: bool = False,
    workers: int = 2,
    progress: Progress = no_progress,
) -> Evaluation:
    """Measure the results of papers, and write the report."""
    papers = papers_named(name)
    presets = [preset for paper in papers for preset in paper.presets]
    databases = prepare_databases(
        presets, inputs, output / "artifacts", workers=workers, progress=progress
    )
    outcomes = [
        run_paper(
            paper, databases, output / "records", quick=quick, workers=workers, progress=progress
        )
        for paper in papers
    ]
    folder = "all" if name.lower() == "all" else papers[0].name
    contents = tuple(outcome.as_dict() for outcome in outcomes)
    report_folder, title = output / _quick(folder, quick), "The papers, reproduced"
    return Evaluation(contents, write_evaluation(report_folder, title, contents, _machine()))


def evaluate_database(
    sweep: Sweep, output: Path, *, workers: int = 2, progress: Progress = no_progress
) -> Evaluation:
    """Measure how often a database identifies, and add it to the report."""
    paper = sweep_paper(sweep)
    outcome = run_paper(
        paper,
        {paper.name: sweep.database},
        output / "records",
        quick=sweep.is_quick,
        workers=workers,
        progress=progress,
    )
    folder = output / _quick(paper.name, sweep.is_quick)
    content = outcome.as_dict()
    contents = with_earlier(folder / RESULTS, content, sweep.database)
    page = write_evaluation(folder, f"{paper.name}, evaluated", contents, _machine())
    return Evaluation((content,), page)


def _quick(name: str, is_quick: bool) -> str:
    return f"{name}-quick" if is_quick else name


def _machine() -> str:
    return (
        f"mean over the frames, processors: {os.cpu_count()} ({platform.machine()}), "
        f"starcat {__version__}, Python {platform.python_version()}"
    )


Content = Mapping[str, Any]


def with_earlier(results: Path, content: Content, database: Path) -> list[dict[str, Any]]:
    """Return a sweep together with the earlier sweeps of the results file."""
    basis = {
        "manifest_sha256": read_manifest(database)["manifest_sha256"],
        "code_sha256": code_sha256(),
    }
    new = json.loads(json.dumps({**content, "measured_with": basis}))
    contents = [old for old in _stored(results) if old["measured_with"] == basis]
    for number, old in enumerate(contents):
        if _camera(old) == _camera(new):
            contents[number] = {**new, "name": old["name"], "rows": _merged(old, new)}
            return contents
    taken = {old["name"] for old in contents}
    names = (f"{new['name']}{end}" for end in ("", *(f"-camera-{n}" for n in range(2, 10**6))))
    return [*contents, {**new, "name": next(name for name in names if name not in taken)}]


def _stored(results: Path) -> list[dict[str, Any]]:
    try:
        stored = json.loads(results.read_bytes())["evaluations"]
        return [old for old in stored if {"measured_with", "name", "rows"} <= set(old)]
    except (OSError, ValueError, KeyError, TypeError):
        return []  # no file, or not of this version: it is written again


def _camera(content: Content) -> Any:
    """Return the camera that the matcher assumed, the same for all rows."""
    return content["rows"][0]["trial"]["assumed"]


def _merged(old: Content, new: Content) -> list[dict[str, Any]]:
    """Return the rows of both, group by group; a new row replaces the old row of its name."""
    again = {row["trial"]["name"] for row in new["rows"]}
    rows = [row for row in old["rows"] if row["trial"]["name"] not in again] + [*new["rows"]]
    groups = list(dict.fromkeys(row["group"] for row in (*old["rows"], *new["rows"])))
    methods = list(dict.fromkeys(row["trial"]["method"] for row in rows))
    return sorted(
        rows,
        key=lambda row: (
            groups.index(row["group"]),
            methods.index(row["trial"]["method"]),
            row["x"] if row["x"] is not None else 0.0,
        ),
    )
