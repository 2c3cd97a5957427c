"""Centroid files: dialects of text, shapes of JSON, arrays of NumPy, and messages about columns."""

from __future__ import annotations

import gzip
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from starcat.errors import ConfigError
from starcat.frames.images.measure import measure_file
from starcat.matcher.centroid_columns import POSITIONS
from starcat.matcher.centroids import (
    MeasuredFrame,
    frames_of_data,
    read_centroid_files,
    upside_down,
)

LIGHT = np.array([100.0, 1.0, 10.0])
PX = [[455.5, 327.25], [125.0, 266.75]]


@pytest.mark.parametrize("name", ["mag", "magnitude", "flux", "sum", "FLUX_AUTO", "mag_best"])
@pytest.mark.parametrize("kind", ["csv", "json"])
def test_brightness_by_any_name_is_used(name: str, kind: str, tmp_path: Path) -> None:
    values = LIGHT if "flux" in name.lower() or name == "sum" else -2.5 * np.log10(LIGHT)
    path = tmp_path / f"a.{kind}"
    if kind == "csv":
        rows = "\n".join(f"{number},{number},{value}" for number, value in enumerate(values))
        path.write_text(f"x_px,y_px,{name}\n{rows}\n")
    else:
        places = [[number, number] for number in range(3)]
        path.write_text(json.dumps({"centroids_px": places, name: values.tolist()}))
    [frame] = read_centroid_files(path)
    assert frame.mag == pytest.approx([-5.0, 0.0, -2.5])
    assert frame.remarks == ()


def test_no_light_is_no_magnitude(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("x_px,y_px,flux\n1,1,0\n2,2,-3\n3,3,\n4,4,1\n5,5,--\n")
    [frame] = read_centroid_files(tmp_path / "a.csv")
    np.testing.assert_array_equal(frame.mag, [np.nan, np.nan, np.nan, 0.0, np.nan])
    (tmp_path / "b.csv").write_text("x_image,y_image,mag_auto\n1,1,99.0\n2,2,7\n")
    [frame] = read_centroid_files(tmp_path / "b.csv")
    np.testing.assert_array_equal(frame.mag, [np.nan, 7.0])  # 99 is none in SExtractor


def test_files_of_spreadsheets_are_read(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes(b"\xef\xbb\xbfflux,x_px,y_px,mag\r\n1,2,3,4\r\n")
    [frame] = read_centroid_files(tmp_path / "a.csv")
    assert frame.centroids_px.tolist() == [[2.0, 3.0]]
    assert frame.mag.tolist() == [4.0]


def test_unknown_columns_are_named(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("x_px,y_px,brightness,snr\n1,1,5,2\n")
    [frame] = read_centroid_files(tmp_path / "a.csv")
    [said] = frame.remarks
    assert frame.mag is None
    assert said.startswith("not used: brightness, snr; used are x_px, y_px (a column of brightness")
    assert "mag, magnitude, flux or sum" in said
    content = {"centroids_px": [[1, 2]], "light": [3], "time": "yesterday", "width_px": 2048}
    (tmp_path / "a.json").write_text(json.dumps({"frames": [content], "observer": "me"}))
    [frame] = read_centroid_files(tmp_path / "a.json")
    used, effect, beside = frame.remarks
    assert used.startswith("not used: light, time, width_px; used are centroids_px")
    assert effect.startswith("time, width_px have no effect: state the time of frames")
    assert beside == "not used: observer, beside 'frames'"
    many = ",".join(f"c{number}" for number in range(40))
    (tmp_path / "b.csv").write_text(f"x_px,y_px,mag,{many}\n1,2,3{',0' * 40}\n")
    [frame] = read_centroid_files(tmp_path / "b.csv")
    assert "c11 and 28 more; used are x_px, y_px, mag" in frame.remarks[0]


@pytest.mark.parametrize("position", POSITIONS, ids=lambda one: one.x)
def test_pixels_begin_where_the_program_begins_them(position, tmp_path: Path) -> None:
    """The centre of the top-left pixel is (0.5, 0.5), in FITS (1, 1), in photutils (0, 0)."""
    first = 0.5 - position.offset_px
    for capitals in (str, str.upper, str.lower):
        if position.is_exact and capitals is not str:
            continue
        if position.x == "x" and capitals is str.upper:
            continue  # X and Y are names of astrometry.net
        names = f"{capitals(position.x)},{capitals(position.y)}"
        (tmp_path / "a.csv").write_text(f"{names}\n{first},{first + 3}\n")
        [frame] = read_centroid_files(tmp_path / "a.csv")
        assert frame.centroids_px.tolist() == [[0.5, 3.5]]
        is_assumed = position.x.lower() == "x"
        assert bool(frame.remarks) is is_assumed
        assert not is_assumed or "the centre of the first pixel is" in frame.remarks[0]


SEXTRACTOR = """#   1 NUMBER      Running object number
#   2 X_IMAGE     Object position along x   [pixel]
#   3 Y_IMAGE     Object position along y   [pixel]
#   4 FLUX_APER   Flux of two apertures     [count]
#   6 MAG_AUTO    Kron-like magnitude       [mag]
    1   456.0   327.75   9.0 8.0   7.5
    2   125.5   267.25   1.0 0.5   99.0
"""
ECSV = """# %ECSV 1.0
# ---
# datatype:
# - {name: x_px, datatype: float64}
# - {name: y_px, datatype: float64}
# schema: astropy-2.0
x_px y_px
455.5 327.25
125.0 266.75
"""
TEXTS = {
    "semicolons": "x_px;y_px\n455.5;327.25\n125;266.75\n",
    "decimal commas": "x_px;y_px\n455,5;327,25\n125;266,75\n",
    "tabs": "x_px\ty_px\n455.5\t327.25\n125\t266.75\n",
    "tabs and decimal commas": "x_px\ty_px\n455,5\t327,25\n125,0\t266,75\n",
    "blanks": "x_px   y_px\n  455.5  327.25\n  125    266.75\n",
    "an empty first column": "mag\tx_px\ty_px\n\t455.5\t327.25\n3\t125\t266.75\n",
    "bars": "x_px | y_px\n455.5 | 327.25\n125 | 266.75\n",
    "quotes": '"x_px","y_px"\n"455.5","327.25"\n"125","266.75"\n',
    "capitals": "X_PX,Y_PX\n455.5,327.25\n125,266.75\n",
    "comments": "# my night\n\n# second\nx_px,y_px\n455.5,327.25\n# between\n125,266.75\n",
    "header of savetxt": "# x_px y_px\n4.555e+02 3.2725e+02\n1.25e+02 2.6675e+02\n",
    "header of savetxt with commas": "# x_px,y_px\n455.5,327.25\n125.0,266.75\n",
    "no header": "455.5,327.25\n125,266.75\n",
    "no header, blanks": "4.555e+02 3.2725e+02\n1.25e+02 2.6675e+02\n",
    "no header, blanks after commas": "455.5, 327.25\n125, 266.75\n",
    "no header, decimal commas": "455,5 327,25\n125 266,75\n",
    "no header, decimal commas and semicolons": "455,5;327,25\n125,0;266,75\n",
    "trailing commas": "x_px,y_px\n455.5,327.25,\n125,266.75,\n",
    "ECSV": ECSV,
    "SExtractor": SEXTRACTOR,
}


@pytest.mark.parametrize("dialect", TEXTS)
def test_dialects_of_text_are_read(dialect: str, tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text(TEXTS[dialect])
    [frame] = read_centroid_files(tmp_path / "a.txt")
    assert frame.centroids_px.tolist() == PX
    expected = ["not used: NUMBER, FLUX_APER, FLUX_APER_5"] if dialect == "SExtractor" else []
    assert [remark.partition(";")[0] for remark in frame.remarks] == expected
    if dialect == "SExtractor":
        np.testing.assert_array_equal(frame.mag, [7.5, np.nan])


@pytest.mark.parametrize(
    "encoded",
    [
        lambda text: text.encode("utf-16"),
        lambda text: b"\xfe\xff" + text.encode("utf-16-be"),
        lambda text: text.encode("latin-1"),
        lambda text: text.encode("utf-8-sig"),
        lambda text: text.replace("\n", "\r\n").encode(),
        lambda text: gzip.compress(text.encode()),
    ],
)
def test_encodings_of_text_are_read(encoded, tmp_path: Path) -> None:
    text = "x_px;y_px;Größe\n455.5;327.25;3\n125;266.75;4\n"
    (tmp_path / "a.csv").write_bytes(encoded(text))
    [frame] = read_centroid_files(tmp_path / "a.csv")
    assert frame.centroids_px.tolist() == PX
    assert "Größe" in frame.remarks[0]


REFUSED = {
    "": "the file is empty; expected a first line x_px,y_px",
    " \n\n": "the file is empty",
    "# a\n# b\n": "has only comments; expected a first line",
    "x_px,y_px\n1,2\n3\n": "line 3: y_px is missing; expected a number, or leave the line out",
    "x_px y_px mag\n1 2 3\n4 5\n": "line 3 has fewer values than the 3 columns x_px, y_px, mag",
    "x_px,y_px\n455,5,327,25\n125,0,266,75\n": "line 2 has 4 values for the 2 columns.*semicolons",
    "x_px;y_px\n1.024,5;7.5\n": "line 2: x_px is '1.024,5'; expected a number",
    "1,2,3,4,5\n6,7,8,9,1\n": "the first line is 5 numbers and no header names them",
    "x_px,y_px,x_px\n1,2,3\n": "two columns are called x_px; rename one of them",
    "col,row\n1,2\n": "has the columns col, row; expected the columns x_px and y_px",
}


@pytest.mark.parametrize("text", REFUSED)
def test_what_is_wrong_with_a_text_is_said(text: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(ConfigError, match=REFUSED[text]) as refused:
        read_centroid_files(tmp_path / "a.csv")
    assert str(tmp_path / "a.csv") in str(refused.value)


def test_lines_that_are_too_long_are_reported(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("x_px,y_px\n455.5,327.25,9\n125,266.75\n")
    [frame] = read_centroid_files(tmp_path / "a.csv")
    assert frame.centroids_px.tolist() == PX
    assert frame.remarks == ("values beyond the 2 columns are not used (line 2)",)


def test_a_comment_that_names_no_known_columns_is_reported(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("# row col\n455.5 327.25\n125 266.75\n")
    [frame] = read_centroid_files(tmp_path / "a.txt")
    assert "read as x_px, y_px, because the comment '# row col' has no known" in frame.remarks[0]


def test_a_column_of_frames_separates_frames(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("frame,x_px,y_px,flux\nb,1,2,1\na,3,4,10\nb,5,6,100\n")
    first, second = read_centroid_files(tmp_path / "a.csv")
    assert (first.name, first.centroids_px.tolist()) == ("b", [[1.0, 2.0], [5.0, 6.0]])
    assert first.mag.tolist() == [0.0, -5.0]
    assert (second.name, second.centroids_px.tolist()) == ("a", [[3.0, 4.0]])


JSONS = {
    "pairs": PX,
    "pairs and magnitudes": [[*pair, 3] for pair in PX],
    "rows": [{"x_px": x, "y_px": y} for x, y in PX],
    "columns": {"x_px": [455.5, 125], "Y_PX": [327.25, 266.75]},
    "columns of pandas": {"x_px": {"0": 455.5, "1": 125}, "y_px": {"0": 327.25, "1": 266.75}},
    "photutils": {"xcentroid": [455.0, 124.5], "ycentroid": [326.75, 266.25]},
    "a frame": {"centroids_px": PX},
    "a list of a frame": [{"centroids_px": PX}],
    "frames": {"frames": [{"centroids_px": PX}]},
    "a list of a list of pairs": [PX],
}


@pytest.mark.parametrize("shape", JSONS)
@pytest.mark.parametrize("indent", [None, 1])
def test_shapes_of_json_are_read(shape: str, indent: int | None, tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(json.dumps(JSONS[shape], indent=indent))
    [frame] = read_centroid_files(tmp_path / "a.json")
    assert (frame.name, frame.remarks) == ("a", ())
    assert frame.centroids_px.tolist() == PX


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"centroids": PX}, "has the keys centroids; expected an object with 'centroids_px'"),
        ([{"col": 1, "row": 2}], "has the keys col, row; expected an object with"),
        ([1, 2], "is no frame; expected an object"),
        ([{"x_px": 1, "y_px": None}], None),
        ({"x_px": [1, 2], "y_px": [3]}, "columns of 1 and 2 values"),
        ({"x_px": [1, "a"], "y_px": [3, 4]}, "row 2: x_px is 'a'; expected a number"),
        ([[1, 2], [3, 4, 5]], "rows of 2 and of 3 numbers"),
        ({"centroids_px": [[1, "a"]]}, "centroid 1: y is 'a'; expected a number"),
        ({"centroids_px": [[1]]}, "centroid 1: \\[1\\]; expected a pair of numbers"),
    ],
)
def test_what_is_wrong_with_json_is_said(content, words, tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(json.dumps(content))
    if words is None:  # a row without a position is not used, as in other tables
        [frame] = read_centroid_files(tmp_path / "a.json")
        assert np.isnan(frame.centroids_px[0, 1])
        return
    with pytest.raises(ConfigError, match=words):
        read_centroid_files(tmp_path / "a.json")


WITHOUT_X = {
    "pairs of a frame": '{"centroids_px": [[455.5, 327.25], [null, 3]]}',
    "NaN": '{"centroids_px": [[455.5, 327.25], [NaN, 3]]}',
    "pairs": "[[455.5, 327.25], [null, 3]]",
    "columns": '{"x_px": [455.5, null], "y_px": [327.25, 3]}',
    "csv": "x_px,y_px\n455.5,327.25\n,3\n",
    "csv with null": "x_px;y_px;mag\n455.5;327.25;3\nnull;3;\n",
    "csv with nan": "x_px,y_px\n455.5,327.25\nnan,3\n",
    "tabs": "x_px\ty_px\n455.5\t327.25\n\t3\n",
}


@pytest.mark.parametrize("kind", WITHOUT_X)
def test_a_place_that_is_null_or_empty_is_read_as_nan(kind: str, tmp_path: Path) -> None:
    path = tmp_path / ("a.json" if WITHOUT_X[kind].startswith(("{", "[")) else "a.csv")
    path.write_text(WITHOUT_X[kind])
    [frame] = read_centroid_files(path)
    np.testing.assert_array_equal(frame.centroids_px, [PX[0], [np.nan, 3.0]])


@pytest.mark.parametrize("name", ["a.json", "a.ndjson"])
def test_a_file_has_one_frame_per_line_as_a_stream_has(name: str, tmp_path: Path) -> None:
    lines = [{"name": "first", "centroids_px": PX}, {"centroids_px": PX[:1]}]
    (tmp_path / name).write_text("\n".join(map(json.dumps, lines)) + "\n")
    first, second = read_centroid_files(tmp_path / name)
    assert (first.name, second.name) == ("first", "a 2")
    assert second.centroids_px.tolist() == PX[:1]
    (tmp_path / name).write_text(json.dumps(lines[0]) + "\n{\n")
    with pytest.raises(ConfigError, match=f"{name}: line 2: not JSON"):
        read_centroid_files(tmp_path / name)


def test_arrays_of_numpy_are_read(tmp_path: Path) -> None:
    x, y = np.array(PX).T
    np.save(tmp_path / "a.npy", PX)
    np.save(tmp_path / "b.npy", np.rec.fromarrays([x + 0.5, y + 0.5], names=["X_IMAGE", "Y_IMAGE"]))
    np.savez_compressed(tmp_path / "c.npz", x_px=x, y_px=y)
    np.savez(tmp_path / "d.npz", PX)
    np.savez(tmp_path / "e.npz", centroids_px=PX, flux=LIGHT[:2])
    for name in ("a.npy", "b.npy", "c.npz", "d.npz", "e.npz"):
        [frame] = read_centroid_files(tmp_path / name)
        assert frame.centroids_px.tolist() == PX
    assert frame.mag.tolist() == [-5.0, 0.0]
    np.save(tmp_path / "a.npy", np.zeros((3, 5)))
    with pytest.raises(ConfigError, match=r"an array of shape \(3, 5\); expected \(N, 2\)"):
        read_centroid_files(tmp_path / "a.npy")
    with zipfile.ZipFile(tmp_path / "a.xlsx", "w") as book:
        book.writestr("xl/workbook.xml", "")
    with pytest.raises(
        ConfigError, match=r"a\.xlsx: is a workbook of Excel; save the table as CSV"
    ):
        read_centroid_files(tmp_path / "a.xlsx")
    np.savez_compressed(tmp_path / "c.npz", x_px=np.zeros(9_000_000))
    with pytest.raises(ConfigError, match="at most 67,108,864 are read"):
        read_centroid_files(tmp_path / "c.npz")
    (tmp_path / "c.npz").write_bytes((tmp_path / "c.npz").read_bytes()[:-30])
    (tmp_path / "d.xlsx").write_bytes(b"PK\x03\x04 no archive")
    words = "begins as a ZIP archive and cannot be unpacked .*Save the table as CSV if it is a spr"
    for name in ("c.npz", "d.xlsx"):
        with pytest.raises(ConfigError, match=f"{name}: {words}"):
            read_centroid_files(tmp_path / name)
    (tmp_path / "a.npy").write_bytes((tmp_path / "a.npy").read_bytes()[:-30])
    with pytest.raises(ConfigError, match="cannot be read as a file of NumPy"):
        read_centroid_files(tmp_path / "a.npy")


def test_a_small_gzip_file_does_not_expand_without_limit(tmp_path: Path) -> None:
    (tmp_path / "a.csv.gz").write_bytes(gzip.compress(b"x_px,y_px\n" + b"\n" * (1 << 27)))
    with pytest.raises(ConfigError, match="expands to more than 67,108,864"):
        measure_file(tmp_path / "a.csv.gz")
    (tmp_path / "a.csv.gz").write_bytes(gzip.compress(b"x_px,y_px\n1,2\n")[:-4])
    with pytest.raises(ConfigError, match="damaged gzip file"):
        measure_file(tmp_path / "a.csv.gz")


PIECES = ("x_px", "y_px", "mag", "frame", "X", "Y", "NUMBER", "nan", "null", "centroids_px", "é",
          *',;\t\n|"# {}[]:.-+e0123456789\0')  # fmt: skip


@given(st.lists(st.sampled_from(PIECES), max_size=60).map("".join))
def test_any_text_is_frames_or_a_message(text: str) -> None:
    path = Path("a.csv")
    for data in (text.encode(), gzip.compress(text.encode())[:-1], text.encode("utf-16")):
        message = "a.csv: "
        try:
            frames = frames_of_data(data, path)
        except ConfigError as error:
            frames, message = [], str(error)
        assert message.startswith("a.csv: ")
        assert all(one.centroids_px.shape[1] == 2 for one in frames)


def test_y_upwards_is_turned_where_that_is_asked_for(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("x_px,y_px\n10,20\n")
    [frame] = measure_file(tmp_path / "a.csv").frames
    assert upside_down(frame, 80).centroids_px.tolist() == [[10.0, 60.0]]
    again = upside_down(MeasuredFrame("a", np.array([[10.0, 60.0]])), 80)
    assert again.centroids_px.tolist() == [[10.0, 20.0]]
