"""What an onboard image has to be before its arrays may be used: sizes, places, rows, order.

Every function yields what is wrong, in words; nothing for a sound image.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcat.geometry.camera import LARGEST_PX
from starcat.onboard.grid import MAX_CELLS, Grid
from starcat.onboard.layout import (
    BLOCK_BYTES,
    DIRECTION_SCALE,
    HEADER,
    HEADER_BYTES,
    KINDS,
    MAX_SECTIONS,
    METHOD_NUMBERS,
    SECTION_ALIGNMENT,
    Sizes,
    check_bytes,
)

Numbers = Mapping[str, int | float]

UNIT_TOLERANCE = 1e-8
"""Directions are of length 1 but for the rounding of their components."""


def sizes_of(header: Numbers) -> Sizes:
    """Return what the size of an image depends on, after `header_problems` has found none."""
    methods = {number: name for name, number in METHOD_NUMBERS.items()}
    cells = int(header["grid_bands"]) * int(header["grid_sectors"])
    return Sizes(
        methods[int(header["method"])], int(header["n_stars"]), int(header["n_features"]), cells
    )


def header_problems(header: Numbers, size_bytes: int) -> Iterator[str]:
    """Yield what is wrong with a header by itself."""
    for name in HEADER.names or ():
        if HEADER[name].kind == "f" and not math.isfinite(header[name]):
            yield f"{name} is {header[name]}; expected a finite number"
    data, total = int(header["data_bytes"]), int(header["total_bytes"])
    expected = {
        "header_bytes": (HEADER_BYTES,),
        "block_bytes": (BLOCK_BYTES,),
        "total_bytes": (size_bytes,),
        "method": tuple(METHOD_NUMBERS.values()),
        "index_bytes": (2 if header["n_stars"] <= 1 << 16 else 4,),
        "n_kvector": (header["n_features"] // 4 + 2,),
    }
    for name, choices in expected.items():
        if header[name] not in choices:
            yield f"{name} is {header[name]}; expected {' or '.join(map(str, choices))}"
    if data % BLOCK_BYTES or data < HEADER_BYTES or data + check_bytes(data) != total:
        yield f"data_bytes is {data}; it does not fit total_bytes {total}"
    ranges = {
        "n_sections": (1, MAX_SECTIONS),
        "width_px": (1, LARGEST_PX),
        "height_px": (1, LARGEST_PX),
        "grid_bands": (1, MAX_CELLS),
        "grid_sectors": (1, MAX_CELLS // max(1, int(header["grid_bands"]))),
        "most_near": (0, header["n_stars"]),
    }
    for name, (least, most) in ranges.items():
        if not least <= header[name] <= most:
            yield f"{name} is {header[name]}; expected {least} to {most}"
    positive = ["focal_length_px", "kvector_slope"]
    if header["method"] == METHOD_NUMBERS["triangle"]:
        positive.append("radius_quantum_rad")
    for name in positive:
        if not header[name] > 0.0:
            yield f"{name} is {header[name]}; expected more than 0"
    for name in ("radius_quantum_rad", "longest_rad"):
        if not header[name] >= 0.0:
            yield f"{name} is {header[name]}; expected 0 or more"


def section_problems(table: NDArray[Any], sizes: Sizes, data_bytes: int) -> Iterator[str]:
    """Yield what is wrong with the places of the sections."""
    kinds, end = table["kind"].tolist(), HEADER_BYTES
    for name, dtype, shape in sizes.sections():
        if kinds.count(KINDS[name]) != 1:
            yield f"section {name}: there {kinds.count(KINDS[name])} times; expected once"
            return
        entry = table[kinds.index(KINDS[name])]
        element = np.dtype(dtype).itemsize * math.prod(shape[1:])
        if (entry["element_bytes"], entry["bytes"]) != (element, element * shape[0]):
            yield (
                f"section {name}: {entry['bytes']} bytes in elements of "
                f"{entry['element_bytes']}; expected {element * shape[0]} in elements of {element}"
            )
    entries = sorted(
        (int(entry["offset"]), int(entry["bytes"]), int(entry["kind"]))
        for entry in table
        if entry["kind"]
    )
    for offset, size, kind in entries:
        if offset % SECTION_ALIGNMENT or offset < end or offset + size > data_bytes:
            yield (
                f"section of kind {kind}: at {offset} with {size} bytes; expected a multiple of "
                f"{SECTION_ALIGNMENT} from {end} on that ends by {data_bytes}"
            )
        end = max(end, offset + size)


def content_problems(header: Numbers, sections: Mapping[str, NDArray[Any]]) -> Iterator[str]:
    """Yield what is wrong with the rows and the order of the sections."""
    n_stars, n_features = int(header["n_stars"]), int(header["n_features"])
    for name, last in (("grid", n_stars), ("kvector", n_features)):
        entries = sections[name].astype(np.int64)
        if entries[0] != 0 or entries[-1] != last or (np.diff(entries) < 0).any():
            yield f"section {name}: does not ascend from 0 to {last}"
    for name in {"triangles", "pairs"} & set(sections):
        rows = sections[name]
        if rows.size and int(rows.max()) >= n_stars:
            yield f"section {name}: row {int(rows.max())} of {n_stars} stars"
        elif (rows[:, 1:] <= rows[:, :-1]).any():
            yield f"section {name}: rows that do not ascend within one of the {name}"
    u = sections["directions"] / DIRECTION_SCALE
    if (np.abs(np.einsum("ij,ij->i", u, u) - 1.0) > UNIT_TOLERANCE).any():
        yield "section directions: not all of length 1"
        return
    cells = Grid(int(header["grid_bands"]), int(header["grid_sectors"])).cells(u)
    counts = np.bincount(cells, minlength=len(sections["grid"]) - 1)
    numbers = sections["star_ids"].astype(np.int64)
    is_same = np.diff(cells) == 0
    if (np.diff(cells) < 0).any() or (np.diff(sections["grid"].astype(np.int64)) != counts).any():
        yield "section grid: not the cells that the stars lie in"
    elif (np.diff(numbers)[is_same] <= 0).any():
        yield "section star_ids: not in order within a cell"
