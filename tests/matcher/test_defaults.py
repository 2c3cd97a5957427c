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
from starcat.matcher.settings import (
    CERTAIN,
    MAX_STEPS,
    NOISE_DEVIATIONS,
    REACH,
    TOLERANCE_PX,
    Settings,
)

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
    log_certain = c_number("onboard/src/internal.h", r"#define STARCAT_LOG_CERTAIN R\((\S+)\)")
    assert math.exp(log_certain) == pytest.approx(CERTAIN, rel=1e-12)
    assert c_number("onboard/src/frame.c", r"options->tolerance_px = R\((\S+)\)") == TOLERANCE_PX
    table = "onboard/integrations/cfs/fsw/tables/starcat_app_tbl.c"
    assert math.exp(c_number(table, r"\.LogChance = ([-\d.]+)")) == pytest.approx(CERTAIN, rel=1e-9)


def test_flight_software_takes_what_python_takes():
    frame, internal = "onboard/src/frame.c", "onboard/src/internal.h"
    least = c_number(internal, r"#define STARCAT_LEAST_PX R\((\S+)\)")
    largest = c_number(internal, r"#define STARCAT_LARGEST_PX R\((\S+)\)")
    for name in ("tolerance_px", "noise_px"):
        assert least <= OPTIONS[name].low < OPTIONS[name].high <= largest
    widest = c_number(frame, r"#define WIDEST_FOV_ERROR R\((\S+)\)")
    assert widest == OPTIONS["fov_error"].high
    assert c_number(frame, r"#define MOST_NOISE_MAG R\((\S+)\)") >= OPTIONS["noise_mag"].high
    assert c_number(internal, r"#define STARCAT_SIGMAS_OF_TOLERANCE R\((\S+)\)") == NOISE_DEVIATIONS
    assert c_number(internal, r"#define STARCAT_REACH R\((\S+)\)") == REACH
    widest_rad = c_number("onboard/src/identify.c", r"#define WIDEST_PRIOR_RAD R\((\S+)\)")
    assert widest_rad >= math.radians(OPTIONS["prior_error_deg"].high)
