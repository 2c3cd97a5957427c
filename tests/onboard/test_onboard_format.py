"""The page on the onboard image, checked by parsing an image with the page alone.

The tables of ``docs/onboard-format.md`` give the places of all fields; the parser does not use
`starcat.database.onboard`, so that a reader who has only the page can do the same.
"""

from __future__ import annotations

import hashlib
import math
import re
import struct
import zlib
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

PAGE = (Path(__file__).parents[2] / "docs" / "onboard-format.md").read_text(encoding="utf-8")

CODES = {"u8": "B", "u16": "H", "u32": "I", "i16": "h", "i32": "i", "i64": "q", "f64": "d"}
MARKS = {"little": "<", "big": ">"}


def tables(heading: str) -> list[list[list[str]]]:
    """Return the tables below a heading, row by row, without their own headings."""
    part = re.split(rf"^#+ {re.escape(heading)}.*$", PAGE, maxsplit=1, flags=re.MULTILINE)[1]
    part = re.split(r"^#+ ", part, maxsplit=1, flags=re.MULTILINE)[0]
    found = re.findall(r"((?:^\|.*\|\n)+)", part, re.MULTILINE)
    return [
        [[cell.strip() for cell in line.strip("|\n").split("|")] for line in table.splitlines()[2:]]
        for table in found
    ]


def unpack(image: bytes, kind: str, at: int, mark: str) -> Any:
    """Return a value of a type as the page writes it."""
    if found := re.fullmatch(r"(\d+) bytes", kind):
        return image[at : at + int(found[1])]
    values = struct.unpack_from(mark + CODES[kind], image, at)
    return values[0]


def read(image: bytes) -> dict[str, Any]:
    """Return header and sections of an image, read as the page describes."""
    (header_rows,) = tables("Header")
    place = {row[2].strip("`"): (int(row[0]), row[1]) for row in header_rows}
    mark = next(
        mark for mark in "<>" if unpack(image, "u32", place["byte_order"][0], mark) == 0x01020304
    )
    made = {name: unpack(image, kind, at, mark) for name, (at, kind) in place.items() if name}
    assert header_rows[-1][0] == "160"
    entry_rows, kind_rows = tables("Section table")
    entry = {row[2].split(",")[0]: (int(row[0]), row[1]) for row in entry_rows}
    sections = {}
    found = re.search(r"(\d+) entries of (\d+) bytes, at (\d+)", PAGE)
    entries, step, start = map(int, found.groups())
    kinds = {int(row[0]): row[1:] for row in kind_rows}
    for n in range(entries):
        kind, at, size, element = (
            unpack(image, code, start + n * step + offset, mark) for offset, code in entry.values()
        )
        if kind:
            name, layout, _, _ = kinds[kind]
            code, _, times = layout.partition(" x ")
            code = f"u{8 * made['index_bytes']}" if code == "index" else code
            width = int(times or 1)
            assert element == width * struct.calcsize(CODES[code])
            flat = struct.unpack_from(f"{mark}{size // element * width}{CODES[code]}", image, at)
            assert at % 64 == 0
            sections[name] = list(zip(*[iter(flat)] * width, strict=True)) if times else list(flat)
    return {"header": made, "sections": sections, "mark": mark, "kinds": kinds}


@pytest.fixture(scope="module", params=["triangle-little", "triangle-big", "pyramid-little"])
def image(
    request: pytest.FixtureRequest, small_database: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[bytes, str, str]:
    """An image as export writes it, its method and its byte order."""
    from starcat.ship.exchange.onboard import export_image

    method, endian = request.param.split("-")
    path = tmp_path_factory.mktemp("image") / "db.img"
    export_image(small_database, "onboard", path, method=method, endian=endian)
    return path.read_bytes(), method, endian


@pytest.fixture(scope="module")
def parsed(image: tuple[bytes, str, str]) -> dict[str, Any]:
    return read(image[0])


@pytest.fixture(scope="module")
def database(small_database: Path) -> Callable[[str], dict[str, list[Any]]]:
    """The products of the database that the images are of."""
    return lambda name: pq.read_table(small_database / f"{name}.parquet").to_pydict()


def test_the_tables_of_the_page_have_no_gaps():
    at = 0
    for offset, kind, _, _ in tables("Header")[0]:
        assert int(offset) == at
        found = re.fullmatch(r"(\d+) bytes", kind)
        at += int(found[1]) if found else struct.calcsize(CODES[kind])
    assert at == 256
    entry, kinds = tables("Section table")
    assert [int(row[0]) for row in entry] == [0, 4, 8, 12]
    assert [int(row[0]) for row in kinds] == list(range(1, 10))


def test_the_header_says_what_the_page_says(image, parsed, small_database):
    data, method, endian = image
    header = parsed["header"]
    assert parsed["mark"] == MARKS[endian]
    assert header["magic"] == b"STARCAT\0"
    assert (header["version_major"], header["version_minor"]) == (1, 0)
    assert header["total_bytes"] == len(data)
    assert header["data_bytes"] % 4096 == 0
    assert header["method"] == {"triangle": 1, "pyramid": 2}[method]
    assert header["index_bytes"] == 2
    assert (header["width_px"], header["height_px"]) == (512, 512)
    assert header["focal_length_px"] == pytest.approx(256 / math.tan(math.radians(20)), abs=1e-9)
    assert header["epoch_jyear"] == 2026.0
    manifest = (small_database / "manifest.json").read_bytes()
    assert header["manifest_sha256"] == hashlib.sha256(manifest).digest()
    assert header["name"] == b"small-1.0.0".ljust(96, b"\0")
    wanted = {"triangle": {1, 2, 3, 4, 5, 6, 7}, "pyramid": {1, 2, 3, 4, 5, 8}}[method]
    assert set(parsed["sections"]) == {parsed["kinds"][kind][0] for kind in wanted}
    assert header["n_sections"] == len(wanted)
    for kind in wanted:
        name, _, count, _ = parsed["kinds"][kind]
        rows = eval(count.replace("`", "").replace(" x ", " * "), {}, header)
        assert len(parsed["sections"][name]) == rows


def test_stars_are_those_of_the_database(parsed, database):
    stars, sections = database("stars"), parsed["sections"]
    row_of = {star_id: row for row, star_id in enumerate(stars["star_id"])}
    assert sorted(sections["star ids"]) == sorted(row_of)
    for star_id, direction, steps in zip(
        sections["star ids"], sections["directions"], sections["magnitudes"], strict=True
    ):
        row = row_of[star_id]
        for axis, whole in zip("xyz", direction, strict=True):
            assert abs(whole / 2147483647 - stars[axis][row]) <= 0.5000001 / 2147483647
        assert abs(steps / 1000 - stars["mag"][row]) <= 0.0005 + 1e-12


def test_cells_are_where_the_formula_says(parsed):
    header, sections = parsed["header"], parsed["sections"]
    bands, sectors = header["grid_bands"], header["grid_sectors"]
    last: tuple[int, int] = (-1, -1)
    for row, (direction, star_id) in enumerate(
        zip(sections["directions"], sections["star ids"], strict=True)
    ):
        x, y, z = (whole / 2147483647 for whole in direction)
        band = min(bands - 1, math.floor((z + 1) / 2 * bands))
        t = y / (abs(x) + abs(y)) if x or y else 0.0
        p = t if x > 0 and y >= 0 else 2 - t if (x <= 0 and y > 0) or x < 0 else 4 + t
        cell = band * sectors + min(sectors - 1, math.floor(p / 4 * sectors))
        assert sections["grid"][cell] <= row < sections["grid"][cell + 1]
        assert (cell, star_id) > last
        last = cell, star_id
    assert (sections["grid"][0], sections["grid"][-1]) == (0, header["n_stars"])


def separation(u: tuple[int, ...], v: tuple[int, ...]) -> float:
    """Return the angle of two stored directions."""
    a, b = ([whole / 2147483647 for whole in w] for w in (u, v))
    return 2 * math.atan2(math.dist(a, b), math.dist(a, [-whole for whole in b]))


def test_features_are_those_of_the_database_by_ascending_value(image, parsed, database):
    header, sections = parsed["header"], parsed["sections"]
    product, columns = {"triangle": ("triangles", "ijk"), "pyramid": ("pairs", "ij")}[image[1]]
    ids, known = database("stars")["star_id"], database(product)
    listed = list(zip(*(known[column] for column in columns), strict=True))
    expected = {tuple(sorted(ids[r] for r in rows)) for rows in listed}
    found = {tuple(sorted(sections["star ids"][r] for r in rows)) for rows in sections[product]}
    side = 2 * math.atan(0.5 * 512 / header["focal_length_px"])
    if image[1] == "pyramid":
        long = dict(zip(listed, known["separation_rad"], strict=True))
        expected -= {
            tuple(sorted(ids[r] for r in rows)) for rows, angle in long.items() if angle > side
        }
    assert found == expected
    values, longest = [], 0.0
    for n, rows in enumerate(sections[product]):
        assert list(rows) == sorted(set(rows))
        u = [sections["directions"][row] for row in rows]
        sides = [separation(u[a], u[b]) for a in range(len(u)) for b in range(a)]
        longest = max(longest, *sides)
        if image[1] == "pyramid":
            values.append(sides[0])
            continue
        half = sum(sides) / 2
        area = math.sqrt(max(0.0, half * math.prod(half - a for a in sides)))
        values.append(area)
        if area > 1e-4:
            steps = math.prod(sides) / (4 * area) / header["radius_quantum_rad"]
            assert abs(sections["radii"][n] - steps) < 0.501 or sections["radii"][n] == 65535
    assert all(b >= a - 1e-9 for a, b in pairwise(values))
    assert header["longest_rad"] == pytest.approx(longest, abs=1e-12)
    check_kvector(parsed, values)


def check_kvector(parsed: dict[str, Any], values: list[float]) -> None:
    """Check the K-vector entry by entry, and that it finds the requested ranges."""
    header, counts = parsed["header"], parsed["sections"]["K-vector"]
    intercept, slope = header["kvector_intercept"], header["kvector_slope"]
    assert (counts[0], counts[-1]) == (0, header["n_features"])
    assert slope > 0
    for k, count in enumerate(counts):
        line = intercept + k * slope
        assert count == 0 or values[count - 1] <= line + 1e-9
        assert count == len(values) or values[count] > line - 1e-9
    for at in range(0, len(values), 97):
        low, high = values[at] - 3 * slope, values[at] + 2 * slope
        first = counts[max(0, math.floor((low - intercept) / slope))]
        last = counts[min(len(counts) - 1, math.ceil((high - intercept) / slope))]
        inside = [n for n, value in enumerate(values) if low <= value <= high]
        assert first <= inside[0]
        assert inside[-1] < last


def test_check_blocks_hold_the_crcs_of_the_data(image, parsed):
    data, (crc_rows,) = image[0], tables("Check blocks")
    header, mark = parsed["header"], parsed["mark"]
    per_block = int(re.fullmatch(r"u32 x (\d+)", crc_rows[0][1])[1])
    at_whole, at_itself = int(crc_rows[1][0]), int(crc_rows[2][0])
    blocks = [data[n : n + 4096] for n in range(0, header["data_bytes"], 4096)]
    checks = [data[n : n + 4096] for n in range(header["data_bytes"], len(data), 4096)]
    assert len(checks) == math.ceil(len(blocks) / per_block)
    stored: list[int] = []
    for check in checks:
        stored += struct.unpack_from(f"{mark}{per_block}I", check, 0)
        assert unpack(check, "u32", at_whole, mark) == zlib.crc32(data[: header["data_bytes"]])
        assert unpack(check, "u32", at_itself, mark) == zlib.crc32(check[:at_itself])
    assert stored[: len(blocks)] == [zlib.crc32(block) for block in blocks]
    assert not any(stored[len(blocks) :])
