"""The sensor of a camera in a spec: its response and its exposure."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, model_validator

from starcat.catalog.bands.exposure import Exposure, photons_s_mm2, zero_point_e_s
from starcat.catalog.bands.response import (
    Response,
    checked_response,
    read_response,
    shipped,
    shipped_names,
)
from starcat.catalog.bands.synthetic import checked_zero_point
from starcat.errors import ConfigError
from starcat.local_files import LocalFile
from starcat.sections import CatalogName, Section

MAX_ROWS = 2000
"""Most rows of a table in a spec."""

Column = Annotated[tuple[float, ...], Field(max_length=MAX_ROWS, strict=False)]


def response_of_file(path: Path, section: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keys of a response from a CSV file; the section can state name and per."""
    response = read_response(path, section.get("per"))
    table = {"wavelength_nm": response.wavelength_nm.tolist(), "value": response.value.tolist()}
    return {"name": section.get("name", path.stem), "per": response.counts, **table}


def _optics_of_file(path: Path, _: Mapping[str, Any]) -> dict[str, Any]:
    response = read_response(path, "photon")
    return {
        "optics_wavelength_nm": response.wavelength_nm.tolist(),
        "optics_transmission": response.value.tolist(),
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
    file: Annotated[str, LocalFile("wavelength_nm and value", response_of_file)] | None = Field(
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
        """Return the response of sensor and optics together; None if none is stated."""
        if self.name is None:
            self._check_that_nothing_is_stated()
            return None
        response = (
            self._response_of_table() if self.wavelength_nm or self.value else shipped(self.name)
        )
        if self.optics_wavelength_nm or self.optics_transmission:
            columns = (self.optics_wavelength_nm, self.optics_transmission)
            optics = checked_response("optics", *columns, "photon")
            # A published zero point is not valid with optics.
            response = response.behind(optics).named(f"{self.name} behind its optics", "vega 0")
        if self.zero_point is not None:
            response = response.named(response.title, checked_zero_point(self.zero_point))
        return response

    def _response_of_table(self) -> Response:
        if self.name in shipped_names():
            raise ConfigError(
                f"name {self.name!r} is that of a response that ships with starcat",
                hint="give your own another name, or leave its table out",
            )
        if self.per is None:
            raise ConfigError(
                "per is missing",
                hint='say what value is relative to: "photon" (quantum efficiency) or "energy" '
                "(A/W)",
            )
        return checked_response(str(self.name), self.wavelength_nm, self.value, self.per)

    def _check_that_nothing_is_stated(self) -> None:
        stated = [key for key in type(self).model_fields if getattr(self, key)]
        if stated:
            raise ConfigError(
                f"name is missing and {', '.join(stated)} stated",
                hint="name a response, such as silicon-cmos, or your own",
            )


USUAL_SIGNAL_TO_NOISE = 5.0
"""Signal-to-noise of a detected star with a useful centroid: the proposal if none is stated."""

SAME_MAG = 0.005
"""Limits are rounded to hundredths of a magnitude."""

NEEDED = (
    *("aperture_mm", "quantum_efficiency", "exposure_s", "read_noise_e", "full_well_e"),
    "psf_sigma_px",
)


def _size(description: str, example: float, *, most: float = 1e9, default: Any = None) -> Any:
    return Field(default, ge=0.0, le=most, description=description, examples=[example])


class CameraExposure(Section):
    """Light and noise of a frame; with them the limits can be asked for as signal-to-noise."""

    is_later = True

    aperture_mm: float | None = _size("diameter of the aperture", 20.0, most=1e5)
    quantum_efficiency: float | None = _size(
        "electrons per photon at the peak of the response, transmission of the optics included",
        0.5,
        most=1.0,
    )
    exposure_s: float | None = _size("exposure in seconds", 0.1, most=1e5)
    read_noise_e: float | None = _size("read noise, electrons", 8.0)
    full_well_e: float | None = _size("electrons that a pixel holds", 50_000.0)
    psf_sigma_px: float | None = Field(
        None,
        ge=0.1,
        le=100.0,
        description="standard deviation of the spot of a star",
        examples=[0.8],
    )
    dark_e_s: float = _size("dark current of a pixel, electrons/s", 50.0, default=0.0)
    sky_e_s: float = _size("stray light and sky in a pixel, electrons/s", 100.0, default=0.0)
    min_snr: float | None = Field(
        None,
        gt=0.0,
        le=1e4,
        description="makes selection.faint_limit_mag the magnitude of this signal-to-noise",
        examples=[5.0],
    )
    reject_saturated: bool = Field(
        False, description="makes selection.bright_limit_mag the magnitude that fills a pixel"
    )

    @model_validator(mode="after")
    def _whole_or_absent(self) -> CameraExposure:
        missing = [name for name in NEEDED if not getattr(self, name)]
        if self == type(self).model_construct() or not missing:
            return self
        raise ValueError(
            f"{', '.join(missing)} missing or 0; electrons follow from {', '.join(NEEDED)} together"
        )

    def exposure(self, response: Response | None) -> Exposure | None:
        """Return the exposure in the band of a response, or of the catalog; None without one."""
        if self.aperture_mm is None or self.quantum_efficiency is None or self.exposure_s is None:
            return None
        photons = photons_s_mm2(response)
        rate = zero_point_e_s(self.aperture_mm, self.quantum_efficiency, photons)
        return Exposure(
            rate * self.exposure_s,
            (self.dark_e_s + self.sky_e_s) * self.exposure_s,
            self.read_noise_e or 0.0,
            self.psf_sigma_px or 1.0,
            self.full_well_e or 0.0,
        )

    def limits(self, response: Response | None) -> dict[str, float]:
        """Return the limits of the selection that the exposure has to determine."""
        exposure, limits = self.exposure(response), {}
        if exposure is not None and self.min_snr is not None:
            limits["faint_limit_mag"] = round(exposure.limit_mag(self.min_snr), 2)
        if exposure is not None and self.reject_saturated:
            limits["bright_limit_mag"] = round(exposure.saturation_mag, 2)
        return limits


def with_limits(content: Any) -> Any:
    """Return the content of a spec with the limits determined by its exposure filled in."""
    if not isinstance(content, dict) or not isinstance(content.get("camera"), dict):
        return content
    camera, selection = content["camera"], content.get("selection", {})
    if not isinstance(camera.get("exposure"), dict) or not isinstance(selection, dict):
        return content
    try:
        response = CameraResponse.model_validate(camera.get("response", {})).response()
        limits = CameraExposure.model_validate(camera["exposure"]).limits(response)
    except ValidationError:
        return content  # the check of the sections will report the error with its key
    return {**content, "selection": {**limits, **selection}} if limits else content


def contradiction(required: dict[str, float], stated: dict[str, float]) -> str | None:
    """Return a message if a stated limit contradicts the limit from the exposure, else None."""
    for key, mag in required.items():
        if abs(stated[key] - mag) > SAME_MAG:
            asked = "min_snr" if key == "faint_limit_mag" else "reject_saturated"
            return (
                f"selection.{key} is {stated[key]:g}, and camera.exposure.{asked} makes it "
                f"{mag:g}; leave one of them out"
            )
    return None


def exposure_proposal(section: CameraExposure, response: Response | None) -> tuple[str, ...]:
    """Return the limits that an exposure proposes, if the spec does not request them."""
    exposure = section.exposure(response)
    if exposure is None or (section.min_snr is not None and section.reject_saturated):
        return ()
    return (
        f"in this exposure a star of {exposure.limit_mag(USUAL_SIGNAL_TO_NOISE):.2f} mag has a "
        f"signal-to-noise of {USUAL_SIGNAL_TO_NOISE:g}, and one of {exposure.saturation_mag:.2f} "
        "mag fills a pixel; camera.exposure.min_snr and reject_saturated make them the limits",
    )


def exposure_notes(
    section: CameraExposure, response: Response | None, faint_limit_mag: float
) -> tuple[str, ...]:
    """Return a note if a stated faint limit is beyond the reach of the exposure."""
    exposure = section.exposure(response)
    if exposure is None or section.min_snr is not None:
        return ()
    reach = exposure.limit_mag(USUAL_SIGNAL_TO_NOISE)
    if faint_limit_mag <= reach:
        return ()
    return (
        f"selection.faint_limit_mag {faint_limit_mag:g} is beyond the sensor: a star of "
        f"{reach:.2f} mag has a signal-to-noise of {USUAL_SIGNAL_TO_NOISE:g}. "
        f"camera.exposure.min_snr = {USUAL_SIGNAL_TO_NOISE:g} instead of the limit makes it that",
    )
