"""Results as plain values: the record of a result, its texts, and the two printers."""

from __future__ import annotations

import dataclasses
import datetime as dt
import json
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import pytest

from starcat.cli.console import MAX_ROWS, MAX_WIDTH, print_rows, show_result
from starcat.errors import SourceError
from starcat.frames.calibration.calibrate import CalibratedFrame
from starcat.pipeline.simulation.selftest import Rates
from starcat.pipeline.specs.reading import preset
from starcat.results import entry, in_record, readable, to_dict


@dataclass(frozen=True)
class Spot:
    """A result of the tests."""

    x_px: float
    name: str = field(default="", metadata=entry(is_none_if_empty=True))
    limit_mag: float | None = field(default=None, metadata=entry(is_optional=True))


@dataclass(frozen=True)
class Night:
    """A result that contains others."""

    file_format: str = field(metadata=entry(key="format"))
    first: Spot = field(metadata=entry(is_spread=True))
    spots: tuple[Spot, ...]
    folder: Path
    error_arcsec: np.ndarray
    pixels: np.ndarray = field(repr=False)

    @property
    @in_record(decimals=2)
    def mean_deg(self) -> float:
        """A property of the record."""
        return 1.23456

    @cached_property
    @in_record(key="last")
    def newest(self) -> list[float]:
        """Another."""
        return [float("inf"), 2.0]

    @property
    def other(self) -> int:
        """Not in the record."""
        raise AssertionError


NIGHT = Night("csv", Spot(1.0), (Spot(2.5, "b", 3.0),), Path("a/b"), np.full(3, np.nan), np.eye(2))


def test_the_fields_and_marked_properties_are_the_record():
    record = to_dict(NIGHT)
    assert record == {
        "format": "csv",
        "x_px": 1.0,
        "name": None,
        "spots": [{"x_px": 2.5, "name": "b", "limit_mag": 3.0}],
        "folder": "a/b",
        "error_arcsec": None,
        "mean_deg": 1.23,
        "last": [None, 2.0],
    }
    assert json.loads(json.dumps(record, allow_nan=False)) == record


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (np.float32(0.5), 0.5),
        (np.bool_(True), True),
        (np.array([1.0, np.nan]), [1.0, None]),
        (np.zeros((0, 3)), []),
        (np.int64(7), 7),
        (float("-inf"), None),
        (dt.datetime(2026, 1, 2, tzinfo=dt.UTC), "2026-01-02T00:00:00+00:00"),
        (SourceError("wrong"), "wrong"),
        (b"\xff", "ff"),
        ({1: (True, None)}, {"1": [True, None]}),
    ],
    ids=repr,
)
def test_plain_values(value, expected):
    found = to_dict({"value": value})["value"]
    assert found == expected
    assert type(found) is type(expected)


def test_a_model_is_a_record_and_anything_else_is_refused():
    spec = preset("gaia-12deg")
    assert to_dict({"spec": spec})["spec"] == spec.model_dump(mode="json")
    with pytest.raises(TypeError, match="object has no plain value"):
        to_dict({"value": object()})


def test_a_repr_has_labels_units_and_the_sizes_of_arrays():
    frame = CalibratedFrame("a", "identified", 12, 9, 0.25, np.array([0.0, 0.0, 0.6, 0.8]), "")
    assert repr(frame) == (
        "<CalibratedFrame frame a; status identified; centroids 12; matched 9; "
        "residual 0.250 px; q body from icrs 0, 0, 0.6, 0.8>"
    )
    large = dataclasses.replace(NIGHT, error_arcsec=np.ones((30, 3)))
    assert "error 30 x 3 values; " in readable(large)


def test_rates_keep_the_keys_of_reports():
    rates = Rates("clean", 0.5, 0.0, 0, None, 10, 9, 8, 0, 1.5, (3,))
    record = to_dict(rates)
    assert "missed" not in record
    assert (record["identified_share"], record["share_of_identifiable"]) == (0.8, 0.888889)
    assert record["least_share"] < 0.8 < record["most_share"]


def test_a_result_is_a_table_of_values_and_a_table_of_each_list(capsys):
    show_result(NIGHT, "A night", columns={"spots": ("name", "limit_mag")})
    lines = [line.rstrip() for line in capsys.readouterr().out.splitlines()]
    assert lines[:3] == ["A night", "format  csv", "x       1.000 px"]
    assert "mean    1.2300 deg" in lines
    assert lines[-4:] == ["spots", "      limit", "name    mag", "b     3.000"]
    show_result([NIGHT], as_json=True)
    assert json.loads(capsys.readouterr().out) == [to_dict(NIGHT)]


def test_rows_that_do_not_fit_are_printed_one_below_the_other(capsys):
    rows = [{f"name_{k}": "a rather long text" for k in range(9)}] * (MAX_ROWS + 2)
    print_rows(rows, "Rows")
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= MAX_WIDTH
    assert text.count("name 8  a rather long text") == MAX_ROWS
    assert f"Rows, the first {MAX_ROWS} of {MAX_ROWS + 2}, row 1" in text
