"""Contents of picture files: their kinds, and compressed files expanded within stated limits.

The kind of a file is detected from its first bytes. The number of pixels is read from a header
before the pixels are expanded.
"""

from __future__ import annotations

import gzip
import io
import re
import warnings
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from starcat.errors import ConfigError, FileMissing, SourceError
from starcat.storage.compressed import (
    GZIP,
    damaged_gzip,
    expanded,
    expanded_beginning,
    expands_too_far,
)
from starcat.storage.file_formats import RAW_MAKERS
from starcat.storage.regular_files import check_regular_file, read_regular_file

if TYPE_CHECKING:
    from astropy.io.fits import Header

MAX_FILE_BYTES = 4 << 30
MAX_PIXELS = 1 << 27
"""Largest number of pixels of a picture: a detector of 11,585 x 11,585."""
MAX_EXPANDED_BYTES = 8 * MAX_PIXELS
"""Largest size of a compressed FITS file after expansion."""
MAX_EXPANDED_PICTURE_BYTES = 1 << 28
"""Largest size of another picture in gzip after expansion; most kinds are compressed themselves."""
FITS = b"SIMPLE  ="
_BLOCK_BYTES = 2880  # FITS files consist of blocks of this size

_KINDS = {
    b"SIMPLE  =": "FITS",
    b"\x89PNG\r\n\x1a\n": "PNG",
    b"II*\0": "TIFF",
    b"MM\0*": "TIFF",
    b"II+\0": "TIFF",
    b"MM\0+": "TIFF",
    b"\xff\xd8\xff": "JPEG",
    b"BM": "BMP",
}
# Brands of the container of HEIC, at byte 8, after its size and "ftyp".
_HEIC_BRANDS = (b"heic", b"heix", b"hevc", b"heim", b"heis", b"mif1", b"msf1")


def unpacked(path: Path) -> bytes:
    """Return the content of a picture's file, expanded if it is in gzip."""
    try:
        data = read_regular_file(path, MAX_FILE_BYTES)
    except FileMissing as error:
        raise FileMissing("no such file", where=path, hint="give an image") from error
    except SourceError as error:
        raise ConfigError(f"{error}; expected an image") from error
    if not data.startswith(GZIP):
        return data
    if expanded_beginning(data, len(FITS)) == FITS:
        return _expanded_fits(data, path)
    return expanded(data, MAX_EXPANDED_PICTURE_BYTES, path)


def _expanded_fits(data: bytes, path: Path) -> bytes:
    """Return the content of a FITS file in gzip.

    Each header is read before the pixels that it announces are expanded, so that a small file
    cannot take the memory of a large picture.
    """
    from astropy.io import fits

    content = bytearray()
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as stream:
            while block := stream.read(_BLOCK_BYTES):
                begin = len(content)
                content += block
                while not _END.search(content, begin) and (block := stream.read(_BLOCK_BYTES)):
                    content += block
                    if len(content) - begin > _MAX_HEADER_BYTES:
                        raise ConfigError(
                            "cannot be read as FITS (a header without end)", where=path
                        )
                text = bytes(content[begin:]).decode("latin-1")
                header = fits.Header.fromstring(text)
                size = _data_bytes(header)
                if _is_image_header(header):
                    check_pixels(_shape_of(header), str(path))
                if len(content) + size > MAX_EXPANDED_BYTES:
                    raise expands_too_far(path, len(data), MAX_EXPANDED_BYTES)
                content += stream.read(size)
    except ConfigError:
        raise
    except (OSError, EOFError, zlib.error) as error:
        raise damaged_gzip(path, error) from error
    except Exception as error:  # a damaged header makes astropy raise whatever it happens to
        raise ConfigError(f"cannot be read as FITS ({error})", where=path) from error
    return bytes(content)


_END = re.compile(rb"END {77}")
_MAX_HEADER_BYTES = 1 << 22


def _is_image_header(header: Header) -> bool:
    kind = str(header.get("XTENSION", "IMAGE")).strip()
    return kind == "IMAGE" or header.get("ZIMAGE") is True


def _shape_of(header: Header) -> tuple[int, ...]:
    """Return the sides of the image of a header, also of a compressed one, the last one first."""
    prefix = "ZNAXIS" if header.get("ZIMAGE") is True else "NAXIS"
    return tuple(int(header[f"{prefix}{n}"]) for n in range(int(header[prefix]), 0, -1))


def _data_bytes(header: Header) -> int:
    """Return the size of the data after a header, in whole blocks."""
    sides = [int(header[f"NAXIS{n}"]) for n in range(1, int(header["NAXIS"]) + 1)]
    values = int(header.get("PCOUNT", 0)) + (int(np.prod(sides, dtype=object)) if sides else 0)
    size = abs(int(header["BITPIX"])) // 8 * int(header.get("GCOUNT", 1)) * values
    return -(-size // _BLOCK_BYTES) * _BLOCK_BYTES


def check_pixels(shape: Sequence[int], where: str = "") -> None:
    """Refuse a picture with too many pixels, before they are expanded.

    ``shape`` can have planes before its last two sides.
    """
    if len(shape) < 2:
        return
    height, width = shape[-2:]
    if height * width > MAX_PIXELS:
        raise ConfigError(
            f"{where}{': ' if where else ''}has {width} x {height} px, {height * width / 1e6:.0f} "
            f"million; pictures of at most {MAX_PIXELS / 1e6:.0f} million are read",
            hint="Cut it, or reduce it",
        )


def kind_of(data: bytes) -> str | None:
    """Return the kind of a picture by its first bytes; None if it is none that starcat reads."""
    if data[4:8] == b"ftyp" and data[8:12] in _HEIC_BRANDS:
        return "HEIC"
    return next((kind for start, kind in _KINDS.items() if data.startswith(start)), None)


def holds_picture(path: Path) -> bool | None:
    """Return whether a file is read as a picture, and not as centroids; None if its name decides.

    A FITS file without an image can be a table of centroids, whatever its name, and a gzip file
    can hold a text.
    """
    if path.suffix.lower() in RAW_MAKERS:
        return True
    data = _beginning(path)
    is_packed = data.startswith(GZIP)
    if is_packed:
        data = expanded_beginning(data, _BEGINNING_BYTES)
    if data.startswith(FITS):
        return _has_image(data, path)
    return kind_of(data) is not None if is_packed else None


_BEGINNING_BYTES = 1 << 16


def _beginning(path: Path) -> bytes:
    """Return the first bytes of a regular file; none if it cannot be read, which readers report."""
    try:
        check_regular_file(path)
        with path.open("rb") as file:
            return file.read(_BEGINNING_BYTES)
    except (OSError, ValueError, SourceError):
        return b""


def _has_image(beginning: bytes, path: Path) -> bool:
    """Return whether a FITS file has an image; True if it is damaged, which its reader reports."""
    from astropy.io import fits

    try:
        with warnings.catch_warnings(action="ignore"):
            header = fits.Header.fromstring(beginning.decode("latin-1"))
            if min(_shape_of(header), default=0) > 0:
                return True  # in the first part, as in most files
            with fits.open(io.BytesIO(unpacked(path)), memmap=False) as parts:
                has_image = any(
                    part.is_image and len(part.shape) >= 2 and min(part.shape) > 0 for part in parts
                )
                return has_image or not any(map(is_table, parts))
    except ConfigError:
        raise
    except Exception:
        return True


def is_table(part: Any) -> bool:
    """Return whether a part of a FITS file is a table, and not an image that a table holds."""
    from astropy.io import fits

    return isinstance(part, fits.BinTableHDU | fits.TableHDU) and not part.is_image
