"""Reading an onboard image: every size, offset and row is checked before it is used.

Images of both byte orders are read. This module shares no code with the onboard library, so that
each is a check of the other.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Directions, Rows
from starcat.database.onboard import layout
from starcat.database.onboard.grid import MAX_CELLS, CellGrid
from starcat.database.onboard.layout import (
    ByteOrder,
    Sizes,
    check_bytes,
    has_check_blocks,
    in_order,
    scrub,
)
from starcat.errors import (
    DatabaseMissing,
    FileMissing,
    OnboardImageError,
    SchemaVersionError,
    SourceError,
    quoted,
)
from starcat.geometry.camera import LARGEST_PX, Camera
from starcat.results import in_record
from starcat.storage.regular_files import check_regular_file, read_regular_file

MAX_IMAGE_BYTES = 4 << 30  # the image has 32-bit offsets
MAX_NAMED = 5
"""Damaged blocks that a message names."""

ADVICE = "export it again with 'starcat export'"


@dataclass(frozen=True)
class OnboardImage:
    """An onboard image."""

    data: bytes = field(repr=False)
    byte_order: ByteOrder
    name: str  # ``<name>-<version>`` of the database
    manifest_sha256: str  # SHA-256 of the database's manifest.json, hexadecimal
    method: str
    camera: Camera = field(repr=False)  # the camera that it was built for
    header: Mapping[str, int | float] = field(repr=False)  # the numbers of the header by name
    # the sections by name, in the byte order of the image
    sections: Mapping[str, NDArray[Any]] = field(repr=False)
    offsets: Mapping[str, int] = field(repr=False)  # start of each section

    def __repr__(self) -> str:
        return f"<OnboardImage {self.name}: {self.method}, {len(self.data):,} bytes>"

    @property
    @in_record()
    def crc(self) -> int:
        """CRC-32 of all data, by which the onboard library distinguishes images."""
        return layout.crc_of(self.data, self.byte_order)

    @property
    @in_record(key="format")
    def version(self) -> str:
        """Version of the format."""
        return f"{self.header['version_major']}.{self.header['version_minor']}"

    @property
    def star_id(self) -> NDArray[np.int64]:
        """Permanent star numbers, shape (N,)."""
        return self.sections["star_ids"].astype(np.int64)

    @property
    def directions(self) -> NDArray[np.float64]:
        """ICRS directions, shape (N, 3), each component rounded to 2^-31."""
        return np.asarray(self.sections["directions"] / layout.DIRECTION_SCALE)

    @property
    def mag(self) -> NDArray[np.float64]:
        """Magnitudes, shape (N,), NaN where unknown."""
        steps = self.sections["magnitudes"].astype(np.int64)
        return np.where(steps == layout.MAG_UNKNOWN, np.nan, steps / layout.MAG_SCALE)

    @property
    def features(self) -> NDArray[np.int64]:
        """Rows of the stars of each triangle or pair, shape (M, 3) or (M, 2)."""
        return self.sections[layout.FEATURES[self.method][0]].astype(np.int64)

    @property
    @in_record(key="header")
    def numbers(self) -> dict[str, int | float]:
        """The numbers of the header, without the mark of the byte order."""
        return {name: value for name, value in self.header.items() if name != "byte_order"}

    @property
    @in_record(key="sections")
    def sizes(self) -> dict[str, dict[str, int]]:
        """Rows and bytes of each section."""
        return {
            name: {"rows": len(part), "bytes": part.nbytes} for name, part in self.sections.items()
        }


def is_image(path: Path) -> bool:
    """Return whether a file begins as an onboard image does."""
    try:
        check_regular_file(path)
        with path.open("rb") as file:
            return file.read(len(layout.MAGIC)) == layout.MAGIC
    except (OSError, SourceError):  # a folder, or no such file: the reader reports it
        return False


def rows_by_number(numbers: Rows, directions: Directions, among: Rows, places: Directions) -> Rows:
    """Return the row of each star among others: by its number, -1 if it is missing.

    Two merged catalogs can have equal numbers. If several stars have the number, the
    nearest star in direction is taken.
    """
    order = np.argsort(among, kind="stable")
    first, end = (np.searchsorted(among[order], numbers, side=side) for side in ("left", "right"))
    row_of = np.full(len(numbers), -1, dtype=np.int64)
    is_there = end > first
    row_of[is_there] = order[first[is_there]]
    for row in np.flatnonzero(end - first > 1).tolist():
        rows = order[first[row] : end[row]]
        row_of[row] = rows[np.argmax(places[rows] @ directions[row])]
    return row_of


def read_onboard_image(source: bytes | Path) -> OnboardImage:
    """Read an onboard image."""
    path = source if isinstance(source, Path) else None
    where = str(path) if path is not None else "the onboard image"
    data = bytes_of_file(path) if path is not None else bytes(source)
    _check_magic(data, where, path)
    header, byte_order = _header(data)
    _check_blocks(data, header, where, path)
    _check_version(header, where)
    for problem in header_problems(header, len(data)):
        raise _damaged(where, problem, path)
    table = np.frombuffer(
        data, in_order(layout.SECTION, byte_order), layout.MAX_SECTIONS, layout.HEADER.itemsize
    )
    sizes = sizes_of(header)
    for problem in section_problems(table, sizes, int(header["data_bytes"])):
        raise _damaged(where, problem, path)
    kinds = {kind: name for name, kind in layout.KINDS.items()}
    offsets = {kinds[int(e["kind"])]: int(e["offset"]) for e in table if int(e["kind"]) in kinds}
    sections = _sections(data, offsets, sizes, byte_order)
    for problem in content_problems(header, sections):
        raise _damaged(where, problem, path)
    raw = np.frombuffer(data, layout.HEADER, 1)[0]
    size_px = int(header["width_px"]), int(header["height_px"])
    return OnboardImage(
        data=data,
        byte_order=byte_order,
        name=bytes(raw["name"]).decode(errors="replace"),
        manifest_sha256=bytes(raw["manifest_sha256"]).hex(),
        method=sizes.method,
        camera=Camera(*size_px, float(header["focal_length_px"])),
        header=header,
        sections=sections,
        offsets=offsets,
    )


def bytes_of_file(path: Path) -> bytes:
    """Return the content of a file that should be an image."""
    try:
        return read_regular_file(path, MAX_IMAGE_BYTES)
    except FileMissing:
        raise DatabaseMissing(
            "does not exist",
            where=path,
            hint="give an onboard image, as 'starcat export --to onboard' writes it",
        ) from None
    except SourceError as error:
        raise OnboardImageError(f"{error}; expected an onboard image", path=path) from error


def _damaged(where: str, problem: str, path: Path | None) -> OnboardImageError:
    return OnboardImageError(problem, where=where, path=path, hint=ADVICE)


def _check_magic(data: bytes, where: str, path: Path | None) -> None:
    """Refuse bytes that are not an image; with whole check blocks they are a damaged image."""
    if data[: len(layout.MAGIC)] != layout.MAGIC and not (data and has_check_blocks(data)):
        raise OnboardImageError(
            f"not an onboard image: begins with {quoted(data[:8])}; expected "
            f"{quoted(layout.MAGIC)}",
            where=where,
            path=path,
            hint="Give a file that 'starcat export --to onboard' wrote",
        )
    if len(data) < layout.HEADER_BYTES:
        problem = f"cut short: {len(data)} bytes; its header alone has {layout.HEADER_BYTES}"
        raise _damaged(where, problem, path)


def _header(data: bytes) -> tuple[dict[str, int | float], ByteOrder]:
    """Return the numbers of the header, in the byte order in which its mark reads right."""
    marks = {int.from_bytes(data[8:12], order): order for order in layout.BYTE_ORDERS}
    byte_order = marks.get(layout.ORDER_WORD, "little")
    raw = np.frombuffer(data, in_order(layout.HEADER, byte_order), 1)[0]
    names = [name for name in layout.HEADER.names or () if layout.HEADER[name].kind in "uf"]
    return {name: raw[name].item() for name in names}, byte_order


def _check_blocks(
    data: bytes, header: Mapping[str, int | float], where: str, path: Path | None
) -> None:
    total = header["total_bytes"]
    if len(data) % layout.BLOCK_BYTES or (len(data) != total and not has_check_blocks(data)):
        raise _damaged(where, f"{len(data):,} bytes; its header says {total:,}", path)
    bad = scrub(data)
    if bad:
        named = ", ".join(map(str, bad[:MAX_NAMED])) + (", ..." if len(bad) > MAX_NAMED else "")
        many = (
            f"{len(bad)} of {len(data) // layout.BLOCK_BYTES} blocks of {layout.BLOCK_BYTES} bytes"
        )
        raise OnboardImageError(
            f"damaged in {many}: {named}", where=where, path=path, bad_blocks=bad, hint=ADVICE
        )


def _check_version(header: Mapping[str, int | float], where: str) -> None:
    version = f"{header['version_major']}.{header['version_minor']}"
    if header["version_major"] != layout.VERSION[0]:
        raise SchemaVersionError(
            f"format {version}; this starcat reads {layout.VERSION[0]}.x",
            where=where,
            product="onboard",
            found=version,
            expected=f"{layout.VERSION[0]}.x",
            hint="Export it again, or install the starcat that wrote it",
        )


def _sections(
    data: bytes, offsets: Mapping[str, int], sizes: Sizes, byte_order: ByteOrder
) -> dict[str, NDArray[Any]]:
    return {
        name: np.frombuffer(
            data, in_order(dtype, byte_order), math.prod(shape), offsets[name]
        ).reshape(shape)
        for name, dtype, shape in sizes.sections()
    }


Numbers = Mapping[str, int | float]

UNIT_TOLERANCE = 1e-8
"""Directions have length 1 up to the rounding of their components."""


def sizes_of(header: Numbers) -> Sizes:
    """Return what the size of an image depends on, after `header_problems` has found none."""
    method = layout.METHODS[int(header["method"]) - 1]
    cells = int(header["grid_bands"]) * int(header["grid_sectors"])
    return Sizes(method, int(header["n_stars"]), int(header["n_features"]), cells)


def header_problems(header: Numbers, size_bytes: int) -> Iterator[str]:
    """Yield what is wrong with a header alone."""
    for name in layout.HEADER.names or ():
        if layout.HEADER[name].kind == "f" and not math.isfinite(header[name]):
            yield f"{name} is {header[name]}; expected a finite number"
    data, total = int(header["data_bytes"]), int(header["total_bytes"])
    expected = {
        "header_bytes": (layout.HEADER_BYTES,),
        "block_bytes": (layout.BLOCK_BYTES,),
        "total_bytes": (size_bytes,),
        "method": tuple(layout.METHOD_NUMBERS.values()),
        "index_bytes": (2 if header["n_stars"] <= 1 << 16 else 4,),
        "n_kvector": (header["n_features"] // 4 + 2,),
    }
    for name, choices in expected.items():
        if header[name] not in choices:
            yield f"{name} is {header[name]}; expected {' or '.join(map(str, choices))}"
    if data % layout.BLOCK_BYTES or data < layout.HEADER_BYTES or data + check_bytes(data) != total:
        yield f"data_bytes is {data}; it does not fit total_bytes {total}"
    ranges = {
        "n_sections": (1, layout.MAX_SECTIONS),
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
    if header["method"] == layout.METHOD_NUMBERS["triangle"]:
        positive.append("radius_quantum_rad")
    for name in positive:
        if not header[name] > 0.0:
            yield f"{name} is {header[name]}; expected more than 0"
    for name in ("radius_quantum_rad", "longest_rad"):
        if not header[name] >= 0.0:
            yield f"{name} is {header[name]}; expected 0 or more"


def section_problems(table: NDArray[Any], sizes: Sizes, data_bytes: int) -> Iterator[str]:
    """Yield what is wrong with the offsets and sizes of the sections."""
    kinds, end = table["kind"].tolist(), layout.HEADER_BYTES
    for name, dtype, shape in sizes.sections():
        if kinds.count(layout.KINDS[name]) != 1:
            yield f"section {name}: there {kinds.count(layout.KINDS[name])} times; expected once"
            return
        entry = table[kinds.index(layout.KINDS[name])]
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
        if offset % layout.SECTION_ALIGNMENT or offset < end or offset + size > data_bytes:
            yield (
                f"section of kind {kind}: at {offset} with {size} bytes; expected a multiple of "
                f"{layout.SECTION_ALIGNMENT} from {end} on that ends by {data_bytes}"
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
    u = sections["directions"] / layout.DIRECTION_SCALE
    if (np.abs(np.einsum("ij,ij->i", u, u) - 1.0) > UNIT_TOLERANCE).any():
        yield "section directions: not all of length 1"
        return
    cells = CellGrid(int(header["grid_bands"]), int(header["grid_sectors"])).cells(u)
    counts = np.bincount(cells, minlength=len(sections["grid"]) - 1)
    numbers = sections["star_ids"].astype(np.int64)
    is_same = np.diff(cells) == 0
    if (np.diff(cells) < 0).any() or (np.diff(sections["grid"].astype(np.int64)) != counts).any():
        yield "section grid: not the cells that the stars lie in"
    elif (np.diff(numbers)[is_same] < 0).any():  # merged catalogs can have equal numbers
        yield "section star_ids: not in order within a cell"
