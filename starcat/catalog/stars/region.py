"""Regions of the sky: a cone, a zone of declination, or a MOC."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, ValidationError, field_validator, model_validator

from starcat.arrays import Array, Directions, Mask
from starcat.errors import ConfigError, ProductError
from starcat.geometry.footprint import Footprint, Ring
from starcat.geometry.sphere import directions_from_radec, radec_from_directions, separation
from starcat.local_files import LocalFile
from starcat.sections import Section
from starcat.storage.regular_files import check_regular_file

MAX_MOC_CHARACTERS = 50_000  # half of the longest text of a spec
MAX_ORDER = 29
MAX_MOC_BYTES = 16 << 20


def _moc_of_file(path: Path, _: Mapping[str, Any]) -> dict[str, Any]:
    """Return the key ``moc`` of a file: FITS, JSON or ASCII."""
    from mocpy import MOC

    check_regular_file(path)
    if path.stat().st_size > MAX_MOC_BYTES:
        raise ConfigError(
            f"{path.stat().st_size:,} bytes; a MOC of a spec has at most {MAX_MOC_BYTES:,}",
            where=path,
        )
    form = {".json": "json", ".txt": "ascii", ".moc": "ascii"}.get(path.suffix.lower(), "fits")
    try:
        return {"moc": MOC.load(str(path), form).to_string("ascii").strip()}
    except Exception as error:  # the library raises whatever its parsers do
        raise ConfigError(
            f"is not a MOC in {form} ({error})",
            where=path,
            hint="name it .fits, .json, or .txt for ASCII",
        ) from error


_CELLS = re.compile(r"(?:([0-9]{1,2})/)?(?:([0-9]{1,19})(?:-([0-9]{1,19}))?)?")


def _check_cells(text: str) -> None:
    """Check each cell of a MOC; mocpy takes ``30/1`` or ``3/4-1`` for other cells, or for none."""
    order, has_cells = -1, False
    for token in text.split():
        match = _CELLS.fullmatch(token)
        if match is None:
            raise ValueError(
                f"is not a MOC in ASCII: {token[:40]!r} is not a cell; write orders, slashes and "
                "cells, such as '3/5-7 4/9'"
            )
        order = order if match[1] is None else int(match[1])
        if not 0 <= order <= MAX_ORDER:
            raise ValueError(f"{token!r} has no order from 0 to {MAX_ORDER} before its cells")
        if match[2] is None:
            continue
        has_cells, count = True, 12 * 4**order
        if not int(match[2]) <= int(match[3] or match[2]) < count:
            raise ValueError(
                f"{token!r}: order {order} has the cells 0 to {count - 1}, the lower one first"
            )
    if not has_cells:
        raise ValueError("has no cells, so that no star is inside")


@lru_cache(maxsize=4)
def _moc(text: str) -> Any:
    from mocpy import MOC

    _check_cells(text)
    try:
        return MOC.from_string(text, "ascii")
    except Exception as error:
        raise ValueError(
            f"is not a MOC in ASCII ({error}); write orders, slashes and cells, such as '3/5-7 4/9'"
        ) from error


class Region(Section):
    """Where guide stars, and boresights of the tiling and the self-test, are: in all regions given.

    A frame whose boresight is near the edge shows guide stars in a part of its field.
    """

    is_later = True

    cone: tuple[float, float, float] | None = Field(
        None,
        strict=False,  # a list in TOML
        description="right ascension and declination of the centre, and the radius, degrees",
        examples=[[266.4, -29.0, 20.0]],
    )
    zone: tuple[float, float] | None = Field(
        None,
        strict=False,  # a list in TOML
        description="least and largest declination, degrees, ends included",
        examples=[[-30.0, 30.0]],
    )
    moc: str | None = Field(
        None,
        min_length=1,
        max_length=MAX_MOC_CHARACTERS,
        description="MOC (Multi-Order Coverage map of the IVOA) in ASCII: orders and nested "
        "HEALPix cells",
        examples=["0/0-3"],
    )
    moc_file: Annotated[str, LocalFile("moc", _moc_of_file)] | None = Field(
        None,
        description="file of a MOC (FITS, JSON or ASCII), beside the spec; the built spec has its "
        "cells",
        examples=["survey.fits"],
    )

    @model_validator(mode="after")
    def _is_on_the_sky(self) -> Region:
        if self.cone is not None and not (
            abs(self.cone[1]) <= 90.0 and 0.0 < self.cone[2] <= 180.0
        ):
            raise ValueError(
                f"cone: found {list(self.cone)}; give a declination from -90 to 90 and a radius "
                "above 0, at most 180 deg"
            )
        if self.zone is not None and not -90.0 <= self.zone[0] < self.zone[1] <= 90.0:
            raise ValueError(
                f"zone: found {list(self.zone)}; give two declinations from -90 to 90, the smaller "
                "first"
            )
        return self

    @property
    def footprint(self) -> Footprint | None:
        """The part of the sphere that is in all regions given; None for the whole sphere."""
        if self == Region():
            return None
        moc = None if self.moc is None else _moc(self.moc)

        def contains(directions: Directions) -> Mask:
            return self.contains(directions, *radec_from_directions(directions))

        smallest = min(self._rings(moc), key=lambda ring: ring.fraction)
        return Footprint("[selection.region]", contains, smallest)

    def contains(self, directions: Directions, ra_deg: Array, dec_deg: Array) -> Mask:
        """Return which directions, with their right ascensions, are in all regions given."""
        inside = np.ones(len(directions), dtype=bool)
        if self.cone is not None:
            centre_ra_deg, centre_dec_deg, radius_deg = self.cone
            centre = directions_from_radec(np.array([centre_ra_deg]), np.array([centre_dec_deg]))
            inside &= separation(directions, centre) <= np.radians(radius_deg)
        if self.zone is not None:
            inside &= (dec_deg >= self.zone[0]) & (dec_deg <= self.zone[1])
        if self.moc is not None:
            from astropy import units

            inside &= _moc(self.moc).contains_lonlat(ra_deg * units.deg, dec_deg * units.deg)
        return inside

    def _rings(self, moc: Any) -> Iterator[Ring]:
        pole = np.array([0.0, 0.0, 1.0])
        yield Ring(pole, -1.0, 1.0)
        if self.cone is not None:
            ra_deg, dec_deg, radius_deg = self.cone
            axis = directions_from_radec(ra_deg, dec_deg)
            yield Ring(axis, float(np.cos(np.radians(radius_deg))), 1.0)
        if self.zone is not None:
            low, high = np.sin(np.radians(self.zone))
            yield Ring(pole, float(low), float(high))
        if moc is not None:
            middle = moc.barycenter()
            radius = float(moc.largest_distance_from_coo_to_vertices(middle).to_value("rad"))
            axis = directions_from_radec(float(middle.ra.deg), float(middle.dec.deg))
            yield Ring(axis, float(np.cos(min(np.pi, 1.01 * radius + 1e-9))), 1.0)

    @field_validator("moc")
    @classmethod
    def _is_moc(cls, value: str | None) -> str | None:
        if value is not None:
            _moc(value)
        return value


def footprint_of_recorded(spec: Mapping[str, Any]) -> Footprint | None:
    """Return the part of the sphere that a recorded spec is for; None for all of it.

    The other keys of the spec are not checked: it may be of an earlier version.

    Raises
    ------
    ProductError
        If the region is not one.
    """
    selection = spec.get("selection")
    region = selection.get("region") if isinstance(selection, dict) else None
    try:
        return None if region is None else Region.model_validate(region).footprint
    except ValidationError as error:
        raise ProductError(
            "selection.region of the recorded spec is not a region",
            hint="fetch or build the database again",
        ) from error
