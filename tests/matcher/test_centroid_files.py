"""Centroid files: the columns that count as brightness, and messages about missing columns."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from starcat.images.solve_files import measure_picture
from starcat.matcher.centroids import (
    MeasuredFrame,
    read_centroid_files,
    said_of_columns,
    upside_down,
)

LIGHT = np.array([100.0, 1.0, 10.0])


@pytest.mark.parametrize("name", ["mag", "magnitude", "flux", "sum"])
@pytest.mark.parametrize("kind", ["csv", "json"])
def test_brightness_by_any_name_is_used(name: str, kind: str, tmp_path: Path) -> None:
    values = LIGHT if name in ("flux", "sum") else -2.5 * np.log10(LIGHT)
    path = tmp_path / f"a.{kind}"
    if kind == "csv":
        rows = "\n".join(f"{number},{number},{value}" for number, value in enumerate(values))
        path.write_text(f"x_px,y_px,{name}\n{rows}\n")
    else:
        places = [[number, number] for number in range(3)]
        path.write_text(json.dumps({"centroids_px": places, name: values.tolist()}))
    [frame] = read_centroid_files(path)
    assert frame.mag == pytest.approx([-5.0, 0.0, -2.5])
    assert frame.ignored == ()
    assert said_of_columns([frame]) is None


def test_no_light_is_no_magnitude(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("x_px,y_px,flux\n1,1,0\n2,2,-3\n3,3,\n4,4,1\n")
    [frame] = read_centroid_files(tmp_path / "a.csv")
    np.testing.assert_array_equal(frame.mag, [np.nan, np.nan, np.nan, 0.0])


def test_files_of_spreadsheets_are_read(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes(b"\xef\xbb\xbfflux,x_px,y_px,mag\r\n1,2,3,4\r\n")
    [frame] = read_centroid_files(tmp_path / "a.csv")
    assert frame.centroids_px.tolist() == [[2.0, 3.0]]
    assert frame.mag.tolist() == [4.0]


def test_unknown_columns_are_named(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("x_px,y_px,brightness,snr\n1,1,5,2\n")
    (tmp_path / "a.json").write_text(json.dumps({"centroids_px": [[1, 2]], "light": [3]}))
    [frame] = read_centroid_files(tmp_path / "a.csv")
    said = said_of_columns([frame])
    assert frame.mag is None
    assert said is not None
    assert "brightness, snr" in said
    assert "mag, magnitude, flux, sum" in said
    assert "light" in str(said_of_columns(read_centroid_files(tmp_path / "a.json")))


def test_y_upwards_is_turned_where_that_is_asked_for(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("x_px,y_px\n10,20\n")
    [frame] = measure_picture(tmp_path / "a.csv").frames
    assert upside_down(frame, 80).centroids_px.tolist() == [[10.0, 60.0]]
    again = upside_down(MeasuredFrame("a", np.array([[10.0, 60.0]])), 80)
    assert again.centroids_px.tolist() == [[10.0, 20.0]]
