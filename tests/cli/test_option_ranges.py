"""One option of an identification has one range and one description in every interface."""

from __future__ import annotations

import math

import numpy as np
import pytest
import typer
from pydantic import TypeAdapter, ValidationError

import starcat
from starcat.cli.main import app
from starcat.cli.options import option_of
from starcat.errors import ConfigError
from starcat.matcher.options import OPTIONS, SIMULATED, IdentifyOptions, Option

NUMBERS = {name: one for name, one in OPTIONS.items() if one.is_number}
IN_SETTINGS = [name for name in NUMBERS if hasattr(starcat.Settings(), name)]
OF_REQUESTS = TypeAdapter(IdentifyOptions)  # as the service reads a request
AS_TEXT = "fov_error"  # the command takes it with a percent sign


COMMANDS = typer.main.get_command(app).commands


def takes(command: str, name: str, value: float) -> bool:
    """Whether a command takes the value of an option."""
    words = {"identify": ["dist", "frame.csv"], "simulate": ["dist", "-o", "frame.csv"]}[command]
    [flag, *_] = next(param for param in COMMANDS[command].params if param.name == name).opts
    return accepts(COMMANDS[command].make_context, command, [*words, f"{flag}={value}"])


def accepts(check, *arguments: object, **named: object) -> bool:
    """Whether an interface takes a value."""
    try:
        check(*arguments, **named)
    except (ConfigError, ValidationError, typer.TyperException):
        return False
    return True


def other_options(name: str) -> dict[str, object]:
    """What goes together with an option."""
    return {"prior_q": (0.0, 0.0, 0.0, 1.0)} if name == "prior_error_deg" else {}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *[("tolerance_px", 0.001), ("noise_px", 0.001), ("noise_mag", 0.0005)],
        *[("time_limit_s", 1e-6), ("most_spots", 20_000), ("max_steps", 0)],
        *((name, one.low) for name, one in NUMBERS.items()),
        *((name, one.high) for name, one in NUMBERS.items() if one.high < math.inf),
        *((name, float(np.nextafter(one.low, -np.inf))) for name, one in NUMBERS.items()),
        *((name, 1.001 * one.high) for name, one in NUMBERS.items() if one.high < math.inf),
    ],
)
def test_all_interfaces_accept_a_value_or_all_refuse_it(name, value):
    option = NUMBERS[name]
    expected = option.low <= value <= option.high
    if isinstance(option.low, int) and name in ("max_steps", "most_spots", "plane"):
        value = math.floor(value) if value < option.low else math.ceil(value)  # whole numbers
    stated = {**other_options(name), name: value}
    found = {
        "REST": accepts(OF_REQUESTS.validate_python, stated),
        "file": accepts(IdentifyOptions, **stated),
    }
    if name != AS_TEXT:
        found["command"] = takes("identify", name, value)
    if name in IN_SETTINGS:
        found["Python"] = accepts(starcat.Settings, **{name: value})
    assert set(found.values()) == {expected}, found


def test_the_arguments_of_a_matcher_have_these_ranges(small_database):
    matcher, frame = starcat.Matcher.open(small_database), np.zeros((5, 2))
    for name, given in (("fov_error", {}), ("prior_error_deg", {"prior": [0.0, 0.0, 0.0, 1.0]})):
        low, high = NUMBERS[name].low, NUMBERS[name].high
        for value in (low, high):
            assert accepts(matcher.identify, frame, **given, **{name: value})
        for value in (np.nextafter(low, -1.0), 1.001 * high):
            assert not accepts(matcher.identify, frame, **given, **{name: value})


def test_the_help_of_an_option_is_the_same_everywhere():
    identify = {param.name: param for param in COMMANDS["identify"].params}
    schema = OF_REQUESTS.json_schema()["properties"]
    for name, option in OPTIONS.items():
        assert schema[name]["description"] == option.description
        assert schema[name]["default"] == option.default == identify[name].default
        if name != "camera":  # the command takes the path of a camera file
            assert identify[name].help == option.described(option_of)
    assert identify["noise_px"].help.endswith("instead of --tolerance-px.")
    assert OPTIONS.keys() == schema.keys()


def test_simulated_frames_have_the_same_noise_in_python_and_on_the_command_line(small_database):
    for name in ("noise_px", "noise_mag"):
        option: Option = SIMULATED[name]
        for value in (option.low, option.high, option.low - 0.1, option.high + 0.1):
            expected = option.low <= value <= option.high
            assert takes("simulate", name, value) is expected
            assert accepts(starcat.simulate, small_database, **{name: value}) is expected


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("14:10", "the narrower one first; write --fov 10:14"),
        ("0:10", "two fields of view between 0 and 180 deg"),
        (
            "12deg",
            "--fov is 12deg; expected a field of view, such as 12, or a range, such as 5:20; write",
        ),
        ("5:20deg", "--fov is 5:20deg; expected a field of view"),
        ("nan:20", "two fields of view between 0 and 180 deg"),
        ("200", "expected a field of view between 0 and 180 deg"),
    ],
)
def test_a_field_that_is_none_gets_a_sentence(starcat, small_database, tmp_path, given, words):
    (tmp_path / "frame.csv").write_text("x_px,y_px\n1,2\n")
    ran = starcat(["identify", small_database, tmp_path / "frame.csv", "--fov", given])
    assert ran.code == 2
    assert words in ran.err
