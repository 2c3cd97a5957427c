"""The defaults of an identification are the same in Python, on the command line, in the service,
in experiments and in flight: who changes one of them is told where the others are.
"""

from __future__ import annotations

import math
import re
from dataclasses import fields
from pathlib import Path

import pytest
from typer.main import get_command

from starcat.cli.main import app
from starcat.matcher.options import OPTIONS, SearchOptions, options_of
from starcat.matcher.settings import CERTAIN, MAX_STEPS, TOLERANCE_PX, Settings

ROOT = Path(__file__).parents[2]


def test_the_settings_state_the_defaults_that_the_descriptions_name():
    assert Settings().max_false_match_probability == CERTAIN == 1e-9
    for name, default in (("tolerance_px", TOLERANCE_PX), ("max_steps", MAX_STEPS)):
        assert getattr(Settings(), name) == default
        assert f"default: {default:,g}." in OPTIONS[name].description
    assert (Settings().min_share, Settings().time_limit_s) == (0.0, math.inf)
    assert Settings(noise_px=0.5).tolerance_px == 1.5


def test_the_command_line_has_the_declared_defaults():
    command = get_command(app).commands["identify"]  # type: ignore[attr-defined]
    options = {one.name: one.default for one in command.params}
    assert {name: options[name] for name in OPTIONS} == {
        name: option.default for name, option in OPTIONS.items()
    }
    assert options_of(SearchOptions).items() <= OPTIONS.items()


def test_experiments_have_the_settings():
    experiment = pytest.importorskip("starcat_lab.experiment").Experiment
    found = {field.name: field.default for field in fields(experiment)}
    assert found["max_false_match_probability"] == CERTAIN
    assert found["tolerance_px"] == TOLERANCE_PX


def c_number(path: str, pattern: str) -> float:
    [text] = re.findall(pattern, (ROOT / path).read_text(encoding="utf-8"))
    return float(text)


def test_flight_software_has_the_settings():
    log_certain = c_number("onboard/src/frame.c", r"#define LOG_CERTAIN R\((\S+)\)")
    assert math.exp(log_certain) == pytest.approx(CERTAIN, rel=1e-12)
    assert c_number("onboard/src/frame.c", r"options->tolerance_px = R\((\S+)\)") == TOLERANCE_PX
    table = "onboard/integrations/cfs/fsw/tables/starcat_app_tbl.c"
    assert math.exp(c_number(table, r"\.LogChance = ([-\d.]+)")) == pytest.approx(CERTAIN, rel=1e-9)
