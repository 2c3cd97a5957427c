"""The map of a user's own table: the meaning, unit and frame of its columns.

A map is a TOML file that the user writes, or one that ships with starcat for a public table. It
names columns, or expressions of columns, for the values of a star (`TableMap`), or for the fields
of an archive if the rows are its records (`ArchiveMap`). This module reads no stars; the rows of a
table get their meaning in `starcat.catalog.archives.mapped`.
"""

from __future__ import annotations

import re
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

UNITS = {
    "ra": "deg",
    "dec": "deg",
    "pm_ra_cosdec": "mas / yr",
    "pm_ra": "mas / yr",
    "pm_dec": "mas / yr",
    "ra_error": "mas",
    "dec_error": "mas",
    "pm_ra_error": "mas / yr",
    "pm_dec_error": "mas / yr",
    "parallax": "mas",
    "parallax_error": "mas",
    "radial_velocity": "km / s",
    "amplitude": "mag",
    "companion_separation": "arcsec",
    "companion_delta_mag": "mag",
    "epoch": "",
    "ruwe": "",
    "hip_number": "",
    "hd_number": "",
}
"""The numbers of [columns], and the unit to which each is converted."""

ASSUMED = {"ra": "deg", "dec": "deg", "amplitude": "mag", "companion_delta_mag": "mag"}
"""Default units if neither the map nor the file states one; other units must be stated."""

REJECTS = ("deleted", "duplicate_record", "minor_planet", "extended", "artifact")
QUALITIES = (
    *("saturated", "photocentre", "blended", "poor_photometry", "dubious_position"),
    *("contaminated", "perhaps_not_a_star"),
)
NAME = r"^[a-z0-9][a-z0-9_-]{0,31}$"
_MOMENT = re.compile(r"[JB]?\d{4}(\.\d*)?|\d{4}-\d\d-\d\d([T ].*)?")
_HUNDREDTH = re.compile(r"\bc(yr|a)\b")
_EQUINOX = re.compile(r"[JB]\d{4}(\.\d*)?")


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Value(_Model):
    """The origin of a value of a star."""

    value: str | float  # a column, an expression of columns, or one number for all rows
    unit: str | None = None  # a unit of astropy.units; default: the unit in the file
    scale: Literal["jyear", "byear", "jd", "mjd"] = "jyear"  # time scale, if the epoch is a column

    @model_validator(mode="after")
    def _check(self) -> Value:
        if self.value == "":
            raise ValueError("is empty; name a column or write an expression, or leave the key out")
        if self.unit is not None:
            unit_of_column(self.unit)
        return self


def _as_value(value: Any) -> Any:
    return {"value": value} if isinstance(value, str | int | float) else value


MapValue = Annotated[Value, BeforeValidator(_as_value)]


def unit_of_column(text: str) -> Any:
    """Return the unit of astropy for a text; `ValueError` if it is not a unit.

    A hundredth of a year is refused: people write ``cyr`` for a century.
    """
    from astropy import units

    if _HUNDREDTH.search(text):
        raise ValueError(
            f"{text!r}: astropy reads cyr as a hundredth of a year; write a century as hyr, such "
            "as arcsec/hyr"
        )
    for form in (None, "cds"):
        try:
            return units.Unit(text, format=form)
        except (ValueError, TypeError):
            continue
    raise ValueError(
        f"{text!r} is no unit of astropy; write it like deg, mas/yr, hourangle, mag, and a century "
        "as hyr"
    )


class StarColumns(_Model):
    """The values of a star; a key that is left out is unknown for all stars."""

    star_id: MapValue = Field(description="its permanent identifier: a whole number, or a text")
    ra: MapValue = Field(description="right ascension, or galactic longitude; may be sexagesimal")
    dec: MapValue = Field(description="declination, or galactic latitude; may be sexagesimal")
    designation: MapValue | None = Field(
        None, description="its name; default: map's name and star_id"
    )
    pm_ra_cosdec: MapValue | None = Field(None, description="proper motion along ra, on the sky")
    pm_ra: MapValue | None = Field(None, description="the same as a change of the coordinate")
    pm_dec: MapValue | None = Field(None, description="proper motion along dec")
    ra_error: MapValue | None = Field(None, description="standard error along ra, on the sky")
    dec_error: MapValue | None = Field(None, description="standard error along dec")
    pm_ra_error: MapValue | None = Field(None, description="standard error of pm_ra_cosdec")
    pm_dec_error: MapValue | None = Field(None, description="standard error of pm_dec")
    parallax: MapValue | None = Field(None, description="parallax")
    parallax_error: MapValue | None = Field(None, description="standard error of parallax")
    radial_velocity: MapValue | None = Field(None, description="radial velocity, away is positive")
    ruwe: MapValue | None = Field(None, description="Gaia's unit weight error")
    spectral_type: MapValue | None = Field(None, description="spectral type")
    amplitude: MapValue | None = Field(None, description="amplitude of a variable star")
    companion_separation: MapValue | None = Field(None, description="separation of a companion")
    companion_delta_mag: MapValue | None = Field(
        None, description="how much fainter a companion is"
    )
    hip_number: MapValue | None = Field(None, description="Hipparcos number")
    hd_number: MapValue | None = Field(None, description="Henry Draper number")


class Flags(_Model):
    """Conditions, such as ``flag = 'D'``."""

    double: str | None = Field(
        None, min_length=1, description="where it holds, the star is flagged double"
    )
    variable: str | None = Field(
        None, min_length=1, description="where it holds, the star is flagged variable"
    )


class Remote(_Model):
    """Addresses of services that have the table."""

    checked: str = Field(description="when and how the addresses were last tried")
    tap: str = Field("", description="address of a TAP service, which 'starcat fetch' asks")
    table: str = Field("", description="name of the table there, as ADQL writes it")
    hats: str = Field(
        "", description="address of a HATS catalog of it, which can be given as an input"
    )
    strip_by: str = Field(
        "", description="of an archive's records: field of the declination, by which TAP is asked"
    )
    limit_by: str = Field(
        "", description="of an archive's records: field of the magnitude that a limit is for"
    )


class AnyMap(_Model):
    """The keys of every map, for any kind of rows."""

    name: str = Field(pattern=NAME, description="of the source, in commands and specs")
    title: str = Field("", description="what the table is")
    identifier: str = Field("", description="where it is catalogued")
    citation: str = Field("", description="what to cite")
    licence: str = Field("", description="on what terms it may be passed on")
    file_names: tuple[str, ...] = Field(
        (), description="names to look for in folders; default: the map's name with any ending"
    )
    table: int | str | None = Field(
        None, description="number or name of the table in a FITS file or VOTable; default: first"
    )
    delimiter: str | None = Field(
        None, min_length=1, max_length=1, description="of a text file; default: the header's"
    )
    names: tuple[str, ...] = Field((), description="columns of a text file without a header")
    encoding: str = Field("utf8", description="of a text file")
    null: tuple[str | float, ...] = Field((), description="texts and numbers that mean no value")
    remote: Remote | None = Field(None, description="where the table is served")

    @property
    def values(self) -> dict[str, Value]:
        """All values and conditions by their names in messages."""
        raise NotImplementedError

    @property
    def asked_by(self) -> tuple[str, str]:
        """The values used in TAP queries: declination, and the magnitude for a limit."""
        raise NotImplementedError

    def recorded(self) -> dict[str, Any]:
        """Return the map in the form for a manifest."""
        return self.model_dump(mode="json", exclude_defaults=True, exclude={"remote"})


class ArchiveMap(AnyMap):
    """A map of a table whose rows are records of an archive: it assigns columns to the fields."""

    archive: str = Field(
        pattern=NAME, description="source of starcat that gives the records their meaning"
    )
    fields: dict[str, MapValue] = Field(
        min_length=1, description="columns or expressions by the archive's fields, in its units"
    )

    @property
    def values(self) -> dict[str, Value]:
        """The fields by their names in messages."""
        return {f"fields.{name}": value for name, value in self.fields.items()}

    @property
    def asked_by(self) -> tuple[str, str]:
        """The fields that `remote` names."""
        remote = self.remote or Remote(checked="")
        return f"fields.{remote.strip_by}", f"fields.{remote.limit_by}"


class TableMap(AnyMap):
    """A map of a table of stars: it states the meaning of the columns."""

    frame: Literal["ICRS", "FK5", "FK4", "galactic"] = Field("ICRS", description="axes of ra, dec")
    equinox: str | None = Field(None, description="default: J2000 of FK5, B1950 of FK4")
    epoch: MapValue = Field(
        description="of the positions: 2016.0, J2000, B1950, a date, or a column"
    )
    columns: StarColumns = Field(description="the values of a star")
    magnitudes: dict[str, MapValue] = Field(
        min_length=1, description="by band, the default first; fluxes become AB magnitudes"
    )
    bands: tuple[str, ...] = Field((), description="their order; default: that of [magnitudes]")
    magnitude_errors: dict[str, MapValue] = Field({}, description="standard errors by band")
    colour: str | None = Field(None, description="two of the bands, such as BP-RP")
    flags: Flags = Flags(double=None, variable=None)
    reject: dict[str, str] = Field(
        {}, description=f"conditions on which a row is rejected: {', '.join(REJECTS)}"
    )
    quality: dict[str, str] = Field({}, description=f"conditions by bit: {', '.join(QUALITIES)}")
    python: str = Field(
        "",
        pattern=r"^$|^[a-z_][a-z0-9_.]*:[a-z_][a-z0-9_]*$",
        description="of a shipped map: function, as module:function, that completes its records",
    )

    @model_validator(mode="after")
    def _check(self) -> TableMap:
        if self.equinox is not None and self.frame not in ("FK4", "FK5"):
            raise ValueError(f"equinox: {self.frame} has none; leave it out, or use FK4 or FK5")
        if self.equinox is not None and not _EQUINOX.fullmatch(self.equinox):
            raise ValueError(f"equinox: {self.equinox!r} is not like J2000 or B1950")
        if self.columns.pm_ra is not None and self.columns.pm_ra_cosdec is not None:
            raise ValueError("columns: give either pm_ra_cosdec or pm_ra, not both")
        has_ra = self.columns.pm_ra is not None or self.columns.pm_ra_cosdec is not None
        if has_ra != (self.columns.pm_dec is not None):
            raise ValueError("columns: a proper motion has two parts; give both or none")
        bands = self.ordered_bands
        if sorted(bands) != sorted(self.magnitudes):
            raise ValueError(f"bands: names {', '.join(bands)}, not each of [magnitudes] once")
        for band in self.magnitude_errors:
            if band not in bands:
                raise ValueError(
                    f"magnitude_errors.{band}: no such band; it has {', '.join(bands)}"
                )
        if self.colour is not None and self.colour_bands is None:
            raise ValueError(f"colour: {self.colour!r} is not two of the bands {', '.join(bands)}")
        for kind, conditions, allowed in (
            ("quality", self.quality, QUALITIES),
            ("reject", self.reject, REJECTS),
        ):
            for name, text in conditions.items():
                if name not in allowed:
                    raise ValueError(f"{kind}.{name}: no such one; choose of {', '.join(allowed)}")
                if not text.strip():
                    raise ValueError(f"{kind}.{name}: is empty; write a condition, or leave it out")
        try:
            _ = self.epoch_jyear
        except ValueError:
            raise ValueError(
                f"epoch: {self.moment!r} is not a date; write it like 2016-01-01"
            ) from None
        return self

    @property
    def ordered_bands(self) -> tuple[str, ...]:
        """The bands, the default first."""
        return self.bands or tuple(self.magnitudes)

    @property
    def colour_bands(self) -> tuple[str, str] | None:
        """The two bands of the colour."""
        pairs = ((a, b) for a in self.magnitudes for b in self.magnitudes)
        return next((pair for pair in pairs if "-".join(pair) == self.colour), None)

    @property
    def moment(self) -> float | str | None:
        """The epoch, if it is the same for all rows."""
        value = self.epoch.value
        if isinstance(value, str) and not _MOMENT.fullmatch(value):
            return None
        return value

    @property
    def epoch_jyear(self) -> float | None:
        """The epoch as a Julian year, if it is the same for all rows."""
        moment = self.moment
        if not isinstance(moment, str):
            return moment
        if moment.replace(".", "", 1).isdigit():
            return float(moment)
        from astropy.time import Time

        return float(Time(moment, scale="tt").jyear)

    @property
    def values(self) -> dict[str, Value]:
        """All values and conditions by their names in messages."""
        values: dict[str, Value] = {}
        for key in StarColumns.model_fields:
            entry = getattr(self.columns, key)
            if entry is not None:
                values[f"columns.{key}"] = entry
        if self.moment is None:
            values["epoch"] = self.epoch
        for kind in ("magnitudes", "magnitude_errors"):
            values |= {f"{kind}.{band}": value for band, value in getattr(self, kind).items()}
        conditions = {"double": self.flags.double, "variable": self.flags.variable}
        values |= {f"flags.{key}": Value(value=text) for key, text in conditions.items() if text}
        # Use the order of the reasons: the first reason that applies is recorded.
        for key in (reason for reason in REJECTS if reason in self.reject):
            values[f"reject.{key}"] = Value(value=self.reject[key])
        return values | {f"quality.{key}": Value(value=text) for key, text in self.quality.items()}

    @property
    def asked_by(self) -> tuple[str, str]:
        """The declination and the first band."""
        return "columns.dec", f"magnitudes.{self.ordered_bands[0]}"

    def recorded(self) -> dict[str, Any]:
        """Return the map for a manifest; JSON keys have no order, so the bands are a list."""
        return {**super().recorded(), "bands": list(self.ordered_bands)}
