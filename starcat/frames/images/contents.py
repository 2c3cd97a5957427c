"""Contents of files of frames: read once, expanded within stated limits, and what they are.

The kind of a picture is detected from its first bytes. The number of pixels is read from a header
before the pixels are expanded.
"""

from __future__ import annotations

import gzip
import io
import re
import warnings
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from starcat.errors import ConfigError, FileMissing, SourceError
from starcat.matcher.centroids import MAX_BYTES, MAX_EXPANDED_BYTES
from starcat.storage.compressed import (
    GZIP,
    damaged_gzip,
    expanded,
    expanded_beginning,
    expands_too_far,
)
from starcat.storage.file_formats import RAW_MAKERS, unread_format
from starcat.storage.regular_files import read_regular_file

if TYPE_CHECKING:
    from astropy.io.fits import Header

MAX_FILE_BYTES = 4 << 30
MAX_PIXELS = 1 << 27
"""Largest number of pixels of a picture: a detector of 11,585 x 11,585."""
MAX_EXPANDED_FITS_BYTES = 8 * MAX_PIXELS
"""Largest size of a compressed FITS file after expansion."""
MAX_EXPANDED_PICTURE_BYTES = 1 << 28
"""Largest size of another picture in gzip after expansion; most kinds are compressed themselves."""
FITS = b"SIMPLE  ="
_SIGNATURE_BYTES = 64  # more than the signature of any kind has
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
IMAGE_SUFFIXES = (
    ".fits", ".fit", ".fts", ".gz", ".fz", ".png", ".tif", ".tiff", ".jpg", ".jpeg", ".heic",
    ".heif", ".bmp",
)  # fmt: skip
"""Suffixes of pictures, for names of files in folders and for contents of an unknown kind."""

# Brands of the container of HEIC, at byte 8, after its size and "ftyp".
_HEIC_BRANDS = (b"heic", b"heix", b"hevc", b"heim", b"heis", b"mif1", b"msf1")


CENTROIDS_OR_IMAGE = "centroids (CSV, JSON) or an image"
RAW_PICTURE = "a raw picture"


@dataclass(frozen=True, eq=False)
class FileContent:
    """The content of a file of frames, expanded if it is in gzip."""

    path: Path
    data: bytes

    @cached_property
    def kind(self) -> str | None:
        """The kind of a picture; None if it is none that starcat reads."""
        if self.path.suffix.lower() in RAW_MAKERS:
            return RAW_PICTURE
        kind = _kind_of(self.data)
        # Raw pictures of cameras begin as TIFF images.
        is_raw = kind == "TIFF" and unread_format(self.path, self.data) is not None
        return None if is_raw else kind

    @cached_property
    def is_picture(self) -> bool:
        """Whether it is read as a picture, and not as centroids."""
        if self.kind == "FITS":
            return _has_image(self.data)
        if self.kind in (None, "BMP"):  # a table of text can begin with BM
            name = self.path.name.lower().removesuffix(".gz")
            return name.endswith(IMAGE_SUFFIXES)
        return True


def read_content(path: Path, expected: str = CENTROIDS_OR_IMAGE) -> FileContent:
    """Read a file of frames.

    Parameters
    ----------
    path : Path
        The file.
    expected : str
        What the file has to be, for messages.

    Raises
    ------
    FileMissing, ConfigError
        If there is no such file, it cannot be read, or it is too large, also after expansion.
    """
    try:
        data = read_regular_file(path, MAX_FILE_BYTES)
    except FileMissing as error:
        raise FileMissing("no such file", where=path, hint=f"give {expected}") from error
    except SourceError as error:
        raise ConfigError(f"{error}; expected {expected}") from error
    if not data.startswith(GZIP):
        content = FileContent(path, data)
        if len(data) > MAX_BYTES and not content.is_picture:
            raise ConfigError(f"has more than {MAX_BYTES:,} bytes of centroids", where=path)
        return content
    beginning = expanded_beginning(data, _SIGNATURE_BYTES)
    if beginning.startswith(FITS):
        content = FileContent(path, _expanded_fits(data, path))
        if len(content.data) > MAX_EXPANDED_BYTES and not content.is_picture:
            raise expands_too_far(path, len(data), MAX_EXPANDED_BYTES)
        return content
    is_picture = FileContent(path, beginning).is_picture
    limit = MAX_EXPANDED_PICTURE_BYTES if is_picture else MAX_EXPANDED_BYTES
    return FileContent(path, expanded(data, limit, path))


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
                if len(content) + size > MAX_EXPANDED_FITS_BYTES:
                    raise expands_too_far(path, len(data), MAX_EXPANDED_FITS_BYTES)
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


def _kind_of(data: bytes) -> str | None:
    if data[4:8] == b"ftyp" and data[8:12] in _HEIC_BRANDS:
        return "HEIC"
    return next((kind for start, kind in _KINDS.items() if data.startswith(start)), None)


_BEGINNING_BYTES = 1 << 16


def _has_image(data: bytes) -> bool:
    """Return whether a FITS file is a picture, and not a table of centroids, whatever its name.

    A damaged file is one, so that the reader of pictures reports the damage.
    """
    from astropy.io import fits

    try:
        with warnings.catch_warnings(action="ignore"):
            header = fits.Header.fromstring(data[:_BEGINNING_BYTES].decode("latin-1"))
            if min(_shape_of(header), default=0) > 0:
                return True  # in the first part, as in most files
            with fits.open(io.BytesIO(data), memmap=False) as parts:
                has_image = any(
                    part.is_image and len(part.shape) >= 2 and min(part.shape) > 0 for part in parts
                )
                return has_image or not any(map(is_table, parts))
    except Exception:
        return True


def is_table(part: Any) -> bool:
    """Return whether a part of a FITS file is a table, and not an image that a table holds."""
    from astropy.io import fits

    return isinstance(part, fits.BinTableHDU | fits.TableHDU) and not part.is_image
