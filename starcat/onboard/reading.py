"""Reading an onboard image: every size, place and row is checked before it is used.

Images of both byte orders are read. This is no part of the onboard library and shares no code
with it, so that each is a check of the other.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcat.errors import (
    ArtifactMissing,
    OnboardImageError,
    SchemaVersionError,
    quoted,
    reason,
)
from starcat.geometry.camera import Camera
from starcat.onboard.blocks import has_check_blocks, scrub
from starcat.onboard.layout import (
    BLOCK_BYTES,
    BYTE_ORDERS,
    DIRECTION_SCALE,
    HEADER,
    HEADER_BYTES,
    KINDS,
    MAG_SCALE,
    MAG_UNKNOWN,
    MAGIC,
    MAX_SECTIONS,
    ORDER_WORD,
    SECTION,
    VERSION,
    ByteOrder,
    Sizes,
    in_order,
)
from starcat.onboard.structure import (
    content_problems,
    header_problems,
    section_problems,
    sizes_of,
)

MAX_NAMED = 5
"""Damaged blocks that a message names."""

ADVICE = "export it again with 'starcat export'"


@dataclass(frozen=True)
class OnboardImage:
    """An onboard image.

    Attributes
    ----------
    data : bytes
        All of it.
    byte_order : {"little", "big"}
        That of the target.
    name : str
        ``<name>-<version>`` of the artifact.
    manifest_sha256 : str
        SHA-256 of the artifact's manifest.json, hexadecimal.
    method : {"triangle", "pyramid"}
        What the features are.
    camera : Camera
        The camera that it was built for.
    header : mapping of str to int or float
        The numbers of the header by name.
    sections : mapping of str to ndarray
        The sections by name, in the byte order of the image.
    """

    data: bytes
    byte_order: ByteOrder
    name: str
    manifest_sha256: str
    method: str
    camera: Camera
    header: Mapping[str, int | float]
    sections: Mapping[str, NDArray[Any]]

    def __repr__(self) -> str:
        """Return name, method and size in one line."""
        return f"<OnboardImage {self.name}: {self.method}, {len(self.data):,} bytes>"

    @property
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
        return np.asarray(self.sections["directions"] / DIRECTION_SCALE)

    @property
    def mag(self) -> NDArray[np.float64]:
        """Magnitudes, shape (N,), NaN where unknown."""
        steps = self.sections["magnitudes"].astype(np.int64)
        return np.where(steps == MAG_UNKNOWN, np.nan, steps / MAG_SCALE)

    @property
    def features(self) -> NDArray[np.int64]:
        """Rows of the stars of each triangle or pair, shape (M, 3) or (M, 2)."""
        name = "triangles" if self.method == "triangle" else "pairs"
        return self.sections[name].astype(np.int64)

    def as_dict(self) -> dict[str, Any]:
        """Return name, numbers and sizes as plain values, for JSON."""
        return {
            "name": self.name,
            "format": self.version,
            "byte_order": self.byte_order,
            "method": self.method,
            "manifest_sha256": self.manifest_sha256,
            "header": {name: self.header[name] for name in self.header if name != "byte_order"},
            "sections": {
                name: {"rows": len(part), "bytes": part.nbytes}
                for name, part in self.sections.items()
            },
        }


def is_image(path: Path) -> bool:
    """Return whether a file begins as an onboard image does."""
    try:
        with path.open("rb") as file:
            return file.read(len(MAGIC)) == MAGIC
    except OSError:  # a folder, or no such file: others say so
        return False


def read_image(source: bytes | Path) -> OnboardImage:
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
    table = np.frombuffer(data, in_order(SECTION, byte_order), MAX_SECTIONS, HEADER.itemsize)
    sizes = sizes_of(header)
    for problem in section_problems(table, sizes, int(header["data_bytes"])):
        raise _damaged(where, problem, path)
    sections = _sections(data, table, sizes, byte_order)
    for problem in content_problems(header, sections):
        raise _damaged(where, problem, path)
    raw = np.frombuffer(data, HEADER, 1)[0]
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
    )


def bytes_of_file(path: Path) -> bytes:
    """Return the content of a file that should be an image."""
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise ArtifactMissing(
            f"{path}: does not exist; give an onboard image, as 'starcat export --to onboard' "
            "writes it",
            path=path,
        ) from None
    except OSError as error:
        raise OnboardImageError(f"{path}: cannot be read ({reason(error)})", path=path) from error


def _damaged(where: str, problem: str, path: Path | None) -> OnboardImageError:
    return OnboardImageError(f"{where}: {problem}; {ADVICE}", path=path)


def _check_magic(data: bytes, where: str, path: Path | None) -> None:
    """Refuse what is no image; one whose check blocks are whole is a damaged image."""
    if data[: len(MAGIC)] != MAGIC and not (data and has_check_blocks(data)):
        raise OnboardImageError(
            f"{where}: not an onboard image: begins with {quoted(data[:8])}; expected "
            f"{quoted(MAGIC)}. Give a file that 'starcat export --to onboard' wrote",
            path=path,
        )
    if len(data) < HEADER_BYTES:
        problem = f"cut short: {len(data)} bytes; its header alone has {HEADER_BYTES}"
        raise _damaged(where, problem, path)


def _header(data: bytes) -> tuple[dict[str, int | float], ByteOrder]:
    """Return the numbers of the header, in the byte order in which its mark reads right."""
    marks = {int.from_bytes(data[8:12], order): order for order in BYTE_ORDERS}
    byte_order = marks.get(ORDER_WORD, "little")
    raw = np.frombuffer(data, in_order(HEADER, byte_order), 1)[0]
    names = [name for name in HEADER.names or () if HEADER[name].kind in "uf"]
    return {name: raw[name].item() for name in names}, byte_order


def _check_blocks(
    data: bytes, header: Mapping[str, int | float], where: str, path: Path | None
) -> None:
    """Refuse an image of which a part is missing, or a block damaged."""
    total = header["total_bytes"]
    if len(data) % BLOCK_BYTES or (len(data) != total and not has_check_blocks(data)):
        raise _damaged(where, f"{len(data):,} bytes; its header says {total:,}", path)
    bad = scrub(data)
    if bad:
        named = ", ".join(map(str, bad[:MAX_NAMED])) + (", ..." if len(bad) > MAX_NAMED else "")
        many = f"{len(bad)} of {len(data) // BLOCK_BYTES} blocks of {BLOCK_BYTES} bytes"
        raise OnboardImageError(
            f"{where}: damaged in {many}: {named}; {ADVICE}", path=path, bad_blocks=bad
        )


def _check_version(header: Mapping[str, int | float], where: str) -> None:
    found = f"{header['version_major']}.{header['version_minor']}"
    if header["version_major"] != VERSION[0]:
        raise SchemaVersionError(
            f"{where}: format {found}; this starcat reads {VERSION[0]}.x. Export it again, or "
            "install the starcat that wrote it",
            product="onboard",
            found=found,
            expected=f"{VERSION[0]}.x",
        )


def _sections(
    data: bytes, table: NDArray[Any], sizes: Sizes, byte_order: ByteOrder
) -> dict[str, NDArray[Any]]:
    """Return the sections as arrays, after `section_problems` has found none."""
    offsets = {int(entry["kind"]): int(entry["offset"]) for entry in table}
    return {
        name: np.frombuffer(
            data, in_order(dtype, byte_order), math.prod(shape), offsets[KINDS[name]]
        ).reshape(shape)
        for name, dtype, shape in sizes.sections()
    }
