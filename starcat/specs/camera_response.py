"""The section ``[camera.response]`` of a spec: in which band the sensor sees.

A response is named, or stands in the spec as a table. A spec file may name a CSV file instead,
which is read with it, so that the spec is whole wherever it travels.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from starcat.bands.response import Response, checked_response, read_response, shipped, shipped_names
from starcat.bands.synthetic import checked_zero_point
from starcat.errors import ConfigError
from starcat.local_files import LocalFile
from starcat.sections import CatalogName, Section

MAX_ROWS = 2000
"""Of a table that travels in a spec."""

Column = Annotated[tuple[float, ...], Field(max_length=MAX_ROWS, strict=False)]


def _response_of_file(path: Path, section: Mapping[str, Any]) -> dict[str, Any]:
    made = read_response(path, section.get("per"))
    table = {"wavelength_nm": made.wavelength_nm.tolist(), "value": made.value.tolist()}
    return {"name": section.get("name", path.stem), "per": made.counts, **table}


def _optics_of_file(path: Path, _: Mapping[str, Any]) -> dict[str, Any]:
    made = read_response(path, "photon")
    return {
        "optics_wavelength_nm": made.wavelength_nm.tolist(),
        "optics_transmission": made.value.tolist(),
    }


class CameraResponse(Section):
    """The band that the sensor sees in; magnitudes and limits are in it, else in the catalog's."""

    is_later = True

    name: str | None = Field(
        None,
        pattern=r"^[0-9A-Za-z][0-9A-Za-z._-]{0,31}$",
        description="a response that ships with starcat ('starcat bands' lists them), or the name "
        "of the one that follows; default: magnitudes stay in the catalog's band",
        examples=["silicon-cmos"],
    )
    file: Annotated[str, LocalFile("wavelength_nm and value", _response_of_file)] | None = Field(
        None,
        description="CSV of wavelengths in nm and responses, beside the spec; the built spec has "
        "its numbers",
        examples=["sensor.csv"],
    )
    per: Literal["photon", "energy"] | None = Field(
        None, description="what the response is relative to", examples=["photon"]
    )
    wavelength_nm: Column = Field((), description="wavelengths of the response, rising")
    value: Column = Field((), description="response at each wavelength, of any scale")
    optics_file: (
        Annotated[str, LocalFile("optics_wavelength_nm and optics_transmission", _optics_of_file)]
        | None
    ) = Field(
        None,
        description="CSV of wavelengths in nm and transmissions of the lens and filters",
        examples=["lens.csv"],
    )
    optics_wavelength_nm: Column = Field((), description="wavelengths of the optics, rising")
    optics_transmission: Column = Field((), description="transmission at each, of any scale")
    photometry: tuple[CatalogName, ...] = Field(
        (),
        strict=False,  # a list in TOML
        description="catalogs whose bands and colours are used as well, found as "
        "[products.crossmatch] says; each magnitude is the mean of all by their errors",
        examples=[["hipparcos"]],
    )
    zero_point: str | None = Field(
        None,
        max_length=16,
        description="vega (Vega has magnitude 0), or a spectral type such as G2V, whose stars then "
        "have the magnitude that they have in V; default: that of the shipped response, else vega",
        examples=["vega"],
    )

    @model_validator(mode="after")
    def _a_response_that_can_be_used(self) -> CameraResponse:
        try:
            self.response()
        except ConfigError as error:
            raise ValueError(str(error)) from error
        return self

    def response(self) -> Response | None:
        """Return the response of sensor and optics together; None where none is stated."""
        if self.name is None:
            self._check_that_nothing_is_stated()
            return None
        found = self._own() if self.wavelength_nm or self.value else shipped(self.name)
        if self.optics_wavelength_nm or self.optics_transmission:
            columns = (self.optics_wavelength_nm, self.optics_transmission)
            optics = checked_response("optics", *columns, "photon")
            # Behind optics no published zero point holds.
            found = found.behind(optics).named(f"{self.name} behind its optics", "vega 0")
        if self.zero_point is not None:
            found = found.named(found.title, checked_zero_point(self.zero_point))
        return found

    def _own(self) -> Response:
        if self.name in shipped_names():
            raise ConfigError(
                f"name {self.name!r} is that of a response that ships with starcat; give your own "
                "another name, or leave its table out"
            )
        if self.per is None:
            raise ConfigError(
                'per is missing; say what value is relative to: "photon" (quantum efficiency) or '
                '"energy" (A/W)'
            )
        return checked_response(str(self.name), self.wavelength_nm, self.value, self.per)

    def _check_that_nothing_is_stated(self) -> None:
        stated = [key for key in type(self).model_fields if getattr(self, key)]
        if stated:
            raise ConfigError(
                f"name is missing and {', '.join(stated)} stated; name a response, such as "
                "silicon-cmos, or your own"
            )
