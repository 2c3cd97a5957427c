"""The defaults of an identification are the same in Python, on the command line, in the service,
in experiments and in flight: who changes one of them is told where the others are.
"""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

from starcat.cli.main import app
from starcat.images.identify_options import MATCHER_OPTIONS, IdentifyOptions
from starcat.matcher.matcher import Matcher
from starcat.matcher.settings import CERTAIN, TOLERANCE_PX, Settings

ROOT = Path(__file__).parents[2]
SETTINGS: Mapping[str, Any] = {field.name: field.default for field in fields(Settings)}
MATCHERS_OWN = {"method", "tolerance_px"}
"""Settings whose default the matcher finds: by the products, and by the noise."""


def agrees(name: str, default: Any) -> bool:
    """Whether the default of an interface is that of the settings, or leaves it to them."""
    return default is None or default == SETTINGS[name]


@pytest.mark.parametrize("name", SETTINGS)
def test_matchers_open_with_the_settings(name):
    for function in (Matcher.open, Matcher.__init__):
        default = inspect.signature(function).parameters[name].default
        assert name in MATCHERS_OWN or default == SETTINGS[name]


def test_the_settings_have_their_tolerance():
    assert Settings().tolerance_px == TOLERANCE_PX
    assert Settings().max_false_match_probability == CERTAIN


@pytest.mark.parametrize("name", MATCHER_OPTIONS)
def test_the_service_and_the_command_line_have_the_settings(name):
    assert agrees(name, IdentifyOptions.model_fields[name].default)
    command = get_command(app).commands["identify"]  # type: ignore[attr-defined]
    [option] = (one for one in command.params if one.name == name)
    assert agrees(name, option.default)


def test_options_about_files_are_the_same_in_the_service_and_on_the_command_line():
    command = get_command(app).commands["identify"]  # type: ignore[attr-defined]
    options = {one.name: one.default for one in command.params}
    shared = set(IdentifyOptions.model_fields) & set(options) - set(MATCHER_OPTIONS)
    assert {"threshold", "most_spots", "bayer", "psf_sigma_px", "plane"} <= shared
    for name in shared:
        assert IdentifyOptions.model_fields[name].default == options[name], name


def test_words_about_defaults_are_true():
    text = IdentifyOptions.model_fields["tolerance_px"].description
    assert f"default: {TOLERANCE_PX:g}." in str(text)
    command = get_command(app).commands["identify"]  # type: ignore[attr-defined]
    [option] = (one for one in command.params if one.name == "tolerance_px")
    assert f"default: {TOLERANCE_PX:g}." in option.help


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
