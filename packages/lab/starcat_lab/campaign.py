"""Runs of all experiments of a paper, and their results.

Experiments run in parallel, one process each. A finished experiment is never run again, so a
campaign that was stopped continues.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from starcat.errors import StarcatError
from starcat.progress import Progress, no_progress
from starcat.results import entry, in_record, to_dict
from starcat_lab.experiment import (
    Experiment,
    ExperimentRow,
    Paper,
    Statistic,
    frame_count,
    run_experiment,
)
from starcat_lab.rates import ExperimentRates, failures_of, rates_by_condition
from starcat_lab.sweep import axis_label

Result = TypeVar("Result")


@dataclass(frozen=True)
class MeasuredRow:
    """A row of a paper and the measured values."""

    row: ExperimentRow = field(metadata=entry(is_spread=True))  # the paper's
    rates: ExperimentRates = field(metadata=entry(is_spread=True))  # of the row's experiment
    # frames without success by the row's rule, by cause
    failures: dict[str, int] = field(default_factory=dict)

    @property
    @in_record()
    def is_goal_reached(self) -> bool | None:
        """Whether rate and mean time reach starcat's goals; None if the row has no goal."""
        row, rates = self.row, self.rates
        if row.goal_percent is None and row.goal_ms is None:
            return None
        share = rates.by_rule if row.goal_over == "all" else rates.by_rule_enough
        is_often = row.goal_percent is None or share.percent >= row.goal_percent
        return is_often and (row.goal_ms is None or rates.mean_ms <= row.goal_ms)

    @property
    @in_record()
    def frames(self) -> int:
        """Number of frames."""
        return self.rates.by_rule.count


@dataclass(frozen=True)
class CampaignOutcome:
    """All measured results of a paper."""

    paper: Paper  # the published results
    is_quick: bool  # whether fewer frames were tried than in the paper
    rows: tuple[MeasuredRow, ...]  # the measured rows, in the paper's order
    statistics: tuple[Statistic, ...]  # numbers that need no experiment

    def as_dict(self) -> dict[str, Any]:
        """Return the outcome as plain values."""
        labels = {measured.row.group: self._axis(measured.row.group) for measured in self.rows}
        return {
            "name": self.paper.name,
            "title": self.paper.title,
            "citation": self.paper.citation,
            "deviations": list(self.paper.deviations),
            "is_quick": self.is_quick,
            "rows": [
                to_dict(measured) | {"axis": labels[measured.row.group]} for measured in self.rows
            ],
            "statistics": [
                to_dict(statistic) | {"is_goal_reached": is_goal_reached(statistic)}
                for statistic in self.statistics
            ],
        }

    def _axis(self, group: str) -> str:
        rows = [measured.row for measured in self.rows if measured.row.group == group]
        points = [(row.experiment, row.x) for row in rows if row.x is not None]
        return axis_label([experiment for experiment, _ in points], [x for _, x in points])


def is_goal_reached(statistic: Statistic) -> bool | None:
    """Return whether a number reaches starcat's goal."""
    measured, goal = statistic.measured, statistic.goal
    if goal is None:
        return None
    if statistic.is_lower_better is None:
        return abs(measured - goal) <= 0.01 * abs(goal)
    return measured <= goal if statistic.is_lower_better else measured >= goal


def run_paper(
    paper: Paper,
    databases: Mapping[str, Path],
    folder: Path,
    *,
    quick: bool = False,
    workers: int = 2,
    progress: Progress = no_progress,
) -> CampaignOutcome:
    """Run all experiments of a paper, except those whose records exist."""
    rows = paper.rows(quick)
    tasks = _tasks(rows, databases)
    records_folder = folder / (f"{paper.name}-quick" if quick else paper.name)
    total = sum(frame_count(experiment) for experiment, _ in tasks)
    done = 0
    progress(paper.name, done, total)
    calls = [(experiment, database, records_folder) for experiment, database in tasks]
    with side_by_side(_run, calls, workers) as finished:
        for experiment in finished:
            done += frame_count(experiment)
            progress(paper.name, done, total)
    measured = tuple(
        _measured(row, records_folder / f"{row.experiment.name}.parquet") for row in rows
    )
    return CampaignOutcome(paper, quick, measured, tuple(paper.statistics(dict(databases), quick)))


def _tasks(
    rows: list[ExperimentRow], databases: Mapping[str, Path]
) -> list[tuple[Experiment, Path]]:
    """Return each experiment once, as rows can share one. The longest come first."""
    tasks: dict[str, tuple[Experiment, Path]] = {}
    for row in rows:
        task = row.experiment, databases[row.preset]
        if tasks.setdefault(row.experiment.name, task) != task:
            raise ValueError(f"two different experiments are named {row.experiment.name!r}")
    return sorted(tasks.values(), key=lambda task: -frame_count(task[0]))


def _measured(row: ExperimentRow, records: Path) -> MeasuredRow:
    rates = rates_by_condition(records, row.rule, row.experiment.attitude_limit_px)
    return MeasuredRow(row, rates, failures_of(records, row.rule, row.experiment.attitude_limit_px))


@contextmanager
def side_by_side(
    work: Callable[..., Result], calls: Sequence[tuple[Any, ...]], workers: int
) -> Iterator[Iterator[Result]]:
    """Yield the results of calls as they end; leaving the block early drops the others."""
    if workers == 1:
        yield (work(*call) for call in calls)
        return
    # Processes are spawned: a forked one inherits locks that the threads of libraries hold, and
    # waits for them without end.
    context, others = multiprocessing.get_context("spawn"), multiprocessing.active_children()
    pool = ProcessPoolExecutor(workers, mp_context=context, initializer=_end_with_parent)
    try:
        futures = [pool.submit(work, *call) for call in calls]
        yield (future.result() for future in as_completed(futures))
    except BrokenProcessPool as error:
        raise StarcatError(
            "the system ended a process, perhaps because memory ran out",
            hint="finished work is kept: run again, with --workers 1",
        ) from error
    except BaseException:
        for process in multiprocessing.active_children():
            if process not in others:
                process.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _run(experiment: Experiment, database: Path, folder: Path) -> Experiment:
    run_experiment(experiment, database, folder)
    return experiment


def _end_with_parent() -> None:
    """Make a process end without a message on Ctrl-C, and when its parent process has ended."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    parent = multiprocessing.parent_process()

    def watch() -> None:
        if parent is not None:
            parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
