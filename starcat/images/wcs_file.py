"""FITS copies of pictures that say where in the sky each pixel is."""

from __future__ import annotations

import gzip
import io
import re
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from starcat.errors import ConfigError, OutputError, reason
from starcat.matcher.result import MatchResult

if TYPE_CHECKING:
    from astropy.io.fits import Header

SUFFIXES = (".fits", ".fit", ".fts")

_OF_A_WCS = re.compile(
    r"(WCSAXES|WCSNAME|C(TYPE|UNIT|RVAL|RPIX|DELT|ROTA)\d|(PC|CD)\d_\d|P[VS]\d_\d+|LONPOLE|LATPOLE"
    r"|RADE(SYS|CSYS)|EQUINOX|MJDREF[IF]?|[AB]P?_(ORDER|DMAX|\d_\d))"
)
"""Keywords that a world coordinate system of a header is made of."""


def expect_room_for_wcs(path: Path, source: Path, *, is_picture: bool) -> None:
    """Check, before anything is done, that a WCS can be written."""
    if path.suffix.lower() not in SUFFIXES:
        raise ConfigError(f"--wcs {path}: a FITS file has a name that ends with .fits")
    if not is_picture:
        raise ConfigError(
            f"--wcs {path}: {source} holds centroids, and a WCS is written into a copy of a "
            "picture; give the picture, or use MatchResult.wcs() in Python"
        )


def write_wcs(
    path: Path,
    source: Path,
    image: NDArray[Any],
    result: MatchResult,
    *,
    flip: bool | None = None,
) -> None:
    """Write a FITS copy of a picture with the world coordinates of its answer."""
    from astropy.utils.exceptions import AstropyWarning

    data = source.read_bytes()
    data = gzip.decompress(data) if data.startswith(b"\x1f\x8b") else data
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", AstropyWarning)  # about headers, as cameras write them
        if data.startswith(b"SIMPLE  ="):
            _copy_fits(data, result, flip, buffer)
        else:
            _new_fits(image, result, buffer)
    try:
        path.write_bytes(buffer.getvalue())
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({reason(error)})", path=path) from error


def _copy_fits(data: bytes, result: MatchResult, flip: bool | None, buffer: io.BytesIO) -> None:
    from astropy.io import fits

    # Values stay as they are stored, whatever the scale of the file.
    with fits.open(io.BytesIO(data), memmap=False, do_not_scale_image_data=True) as parts:
        part = next(
            part for part in parts if part.is_image and len(part.shape) >= 2 and min(part.shape) > 0
        )
        order = str(part.header.get("ROWORDER", "")).strip().upper()
        bottom_up = order == "BOTTOM-UP" if flip is None else flip
        for key in [key for key in part.header if _OF_A_WCS.fullmatch(key)]:
            del part.header[key]
        _add_wcs(part.header, result, bottom_up)
        parts.writeto(buffer, output_verify="silentfix+ignore")


def _new_fits(image: NDArray[Any], result: MatchResult, buffer: io.BytesIO) -> None:
    from astropy.io import fits

    part = fits.PrimaryHDU(np.ascontiguousarray(image))
    part.header["ROWORDER"] = ("TOP-DOWN", "the first row is the top one")
    _add_wcs(part.header, result, bottom_up=False)
    part.writeto(buffer)


def _add_wcs(header: Header, result: MatchResult, bottom_up: bool) -> None:
    """Add the keywords of a WCS; SIP is beyond what the standard has, and is written too."""
    for card in result.wcs(bottom_up=bottom_up).to_header(relax=True).cards:
        if not card.keyword.startswith("MJDREF"):  # which would be the time of no observation
            header.append(card, end=True)
