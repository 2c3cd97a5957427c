"""Identification rates of a database as frames get worse: a few points along a few quantities.

A sweep (`starcat_lab.sweep`) is a whole report; these curves are for a page.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from starcat.progress import Progress, no_progress
from starcat.results import to_dict
from starcat_lab.experiment import run_experiment
from starcat_lab.rates import rates_by_condition
from starcat_lab.sweep import NOISE_PX, PARAMETERS, plan_sweep, sweep_paper

QUANTITIES = ("noise_px", "false_stars", "drop_probability")
"""Quantities of the curves, each with its usual values."""

STAGE = "curves"


def measure_curves(
    database: Path, folder: Path, frames: int, seed: int, progress: Progress = no_progress
) -> list[dict[str, Any]]:
    """Return a curve for each quantity: shares of all pointings with Wilson's interval of 95 %.

    ``folder`` gets the records of the experiments.
    """
    values = {name: PARAMETERS[name].usual for name in QUANTITIES}
    sweep = plan_sweep(database, values, frames=frames, seed=seed)
    rows = sweep_paper(sweep).rows(False)
    curves = {PARAMETERS[name].label: _empty(name) for name in QUANTITIES}
    for number, row in enumerate(rows):
        progress(STAGE, number, len(rows))
        experiment = replace(row.experiment, engine="auto")
        records = run_experiment(experiment, database, folder)
        rates = rates_by_condition(records, row.rule, experiment.attitude_limit_px)
        point = {"x": row.x, **to_dict(rates.by_rule), "wrong": rates.wrong}
        curves[row.group]["points"].append(point)
    progress(STAGE, len(rows), len(rows))
    return list(curves.values())


def _empty(name: str) -> dict[str, Any]:
    fixed = "" if name == "noise_px" else f"position noise {NOISE_PX:g} px"
    return {"quantity": name, "label": PARAMETERS[name].label, "held": fixed, "points": []}
