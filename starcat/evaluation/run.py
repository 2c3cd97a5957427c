"""What ``starcat evaluate`` does: artifacts, trials, report.

An output folder holds ``artifacts/``, ``records/`` with a Parquet file a trial, and a folder a
report, named after what was asked for.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from starcat.evaluation.campaign import run_paper
from starcat.evaluation.earlier import with_earlier
from starcat.evaluation.papers.table import papers_named
from starcat.evaluation.report.files import RESULTS, write_evaluation
from starcat.evaluation.report.files import write_reproduction as write_page
from starcat.evaluation.sweep import Sweep, sweep_paper
from starcat.pipeline.build import Inputs, build
from starcat.progress import Progress, no_progress
from starcat.specs.reading import preset
from starcat.version import __version__


@dataclass(frozen=True)
class Evaluation:
    """What was measured, and where it is written down."""

    contents: tuple[dict[str, Any], ...]  # `Outcome.as_dict` of each paper or sweep
    page: Path  # the report, ``index.html``; its tables and curves are beside it


def prepare_artifacts(
    presets: Iterable[str],
    inputs: Inputs,
    folder: Path,
    *,
    workers: int = 2,
    progress: Progress = no_progress,
) -> dict[str, Path]:
    """Build the artifacts that papers need."""
    artifacts = {}
    for name in dict.fromkeys(presets):

        def forward(stage: str, done: int, total: int | None, name: str = name) -> None:
            progress(f"build {name}", done, total)

        spec = preset(name)
        given = {source: paths for source, paths in inputs.items() if source in spec.sources}
        built = build(spec, given, folder, replace=True, workers=workers, progress=forward)
        artifacts[name] = built.folder
    return artifacts


def evaluate_papers(
    name: str,
    inputs: Inputs,
    output: Path,
    *,
    quick: bool = False,
    workers: int = 2,
    progress: Progress = no_progress,
) -> Evaluation:
    """Measure what papers print, and write the report."""
    papers = papers_named(name)
    presets = [preset for paper in papers for preset in paper.presets]
    artifacts = prepare_artifacts(
        presets, inputs, output / "artifacts", workers=workers, progress=progress
    )
    outcomes = [
        run_paper(
            paper, artifacts, output / "records", quick=quick, workers=workers, progress=progress
        )
        for paper in papers
    ]
    folder = "all" if name.lower() == "all" else papers[0].name
    contents = tuple(outcome.as_dict() for outcome in outcomes)
    place, title = output / _quick(folder, quick), "The papers, reproduced"
    return Evaluation(contents, write_evaluation(place, title, contents, _machine()))


def evaluate_artifact(
    sweep: Sweep, output: Path, *, workers: int = 2, progress: Progress = no_progress
) -> Evaluation:
    """Measure how often an artifact identifies, and add it to the report."""
    paper = sweep_paper(sweep)
    outcome = run_paper(
        paper,
        {paper.name: sweep.artifact},
        output / "records",
        quick=sweep.is_quick,
        workers=workers,
        progress=progress,
    )
    folder = output / _quick(paper.name, sweep.is_quick)
    content = outcome.as_dict()
    contents = with_earlier(folder / RESULTS, content, sweep.artifact)
    page = write_evaluation(folder, f"{paper.name}, evaluated", contents, _machine())
    return Evaluation((content,), page)


def write_reproduction(output: Path, docs: Path) -> Path:
    """Write ``reproduction.md`` and its figures from the full run of all papers."""
    return write_page(output / "all" / RESULTS, docs)


def _quick(name: str, is_quick: bool) -> str:
    return f"{name}-quick" if is_quick else name


def _machine() -> str:
    """Say what the times were measured on."""
    return (
        f"mean over the frames, processors: {os.cpu_count()} ({platform.machine()}), "
        f"starcat {__version__}, Python {platform.python_version()}"
    )
