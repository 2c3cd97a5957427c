"""A star sensor as TOML: how it converts star light to electrons, and its unknown errors.

A database defines the optics, the size of the detector and the stars.
"""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, ValidationError, model_validator

from starcat.catalog.bands.exposure import PHOTONS_S_MM2, zero_point_e_s
from starcat.pipeline.specs.keys import toml_value
from starcat.sections import Mag, Section
from starcat.storage.toml_files import content_of_toml, text_of_toml, what_is_wrong

Positive = Annotated[float, Field(gt=0.0, le=1e15)]
Size = Annotated[float, Field(ge=0.0, le=1e15)]
Efficiency = Annotated[float, Field(gt=0.0, le=1.0)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Signed = Annotated[float, Field(ge=-1e6, le=1e6)]
Rate = Annotated[float, Field(ge=0.0, le=30.0)]
Angle = Annotated[float, Field(ge=0.0, le=180.0)]
Sigma = Annotated[float, Field(ge=0.3, le=10.0)]
Flux = Annotated[float, Field(ge=0.0, le=1e7)]
Spots = Annotated[int, Field(ge=0, le=1000)]
Several = Field(max_length=8)
Triple = tuple[Signed, Signed, Signed]

LEFT_OUT = ("zero_point_e_s", "limit_mag")
"""Keys that are comments in the example."""


def _key(default: Any, description: str, example: Any = None) -> Any:
    """Return a key with its default (an ellipsis if required), meaning, unit, and example."""
    return Field(default, description=description, examples=None if example is None else [example])


class Sensor(Section):
    """A star sensor; light, detector, what it does with a frame, what is not known, trials."""

    zero_point_e_s: Positive | None = _key(
        None,
        "electrons/s of a star of magnitude 0 in the band of the database; or else aperture_mm and "
        "quantum_efficiency",
        6.0e6,
    )
    aperture_mm: Positive | None = _key(None, "diameter of the aperture, mm", 20.0)
    quantum_efficiency: Efficiency | None = _key(
        None, "electrons per photon, transmission of the optics included", 0.5
    )
    photons_s_mm2: Positive = _key(
        PHOTONS_S_MM2,
        "photons/s and mm2 of a star of magnitude 0; the default is Liebe's 19,100 electrons "
        "(2002) at a quantum efficiency of 0.5",
    )
    exposure_s: Positive = _key(..., "exposure, s", 0.1)
    psf_sigma_px: Sigma = _key(..., "standard deviation of the Gaussian spot, px", 0.8)
    pixel_um: Positive = _key(..., "pixel, um", 12.0)
    read_noise_e: Size = _key(..., "read noise, electrons", 8.0)
    full_well_e: Positive = _key(..., "electrons that a pixel holds", 50_000.0)
    gain_e_adu: Positive = _key(..., "electrons of a step of the converter", 12.5)
    bits: Annotated[int, Field(ge=6, le=16)] = _key(12, "bits of the converter")
    offset_adu: Size = _key(50.0, "level without light, steps")
    dark_e_s: Size = _key(0.0, "dark current of a pixel, electrons/s", 50.0)
    sky_e_s: Size = _key(0.0, "stray light and sky in a pixel, electrons/s", 100.0)
    prnu: Share = _key(0.0, "photo response non-uniformity, standard deviation, share", 0.01)
    dsnu_e_s: Size = _key(0.0, "dark signal non-uniformity, standard deviation, electrons/s", 20.0)
    hot_pixel_share: Share = _key(
        0.0, "share of hot pixels at end of life, unknown to the sensor", 0.001
    )
    hot_pixel_e_s: Size = _key(
        20_000.0, "mean dark current of a hot pixel (exponential), electrons/s"
    )
    threshold_sigma: Annotated[float, Field(ge=2.0, le=100.0)] = _key(
        5.0, "threshold of detection, standard deviations"
    )
    limit_mag: Mag | None = _key(
        None, "fainter spots are not used, mag; default: 0.3 beyond the database's", 6.3
    )
    most_spots: Annotated[int, Field(ge=4, le=10_000)] = _key(64, "brightest spots that are used")
    update_rate_hz: Positive = _key(..., "frames/s", 5.0)
    processing_s: Size = _key(0.0, "from the end of an exposure to the attitude, s", 0.2)
    alignment_arcsec: Triple = _key(
        (0.0, 0.0, 0.0), "error of the alignment about x, y, z, arcsec: bias", [5.0, -3.0, 10.0]
    )
    thermo_elastic_arcsec: Triple = _key(
        (0.0, 0.0, 0.0),
        "thermo-elastic error about x, y, z, arcsec: reported as stated",
        [1.0, 1.0, 2.0],
    )
    principal_point_error_px: tuple[Signed, Signed] = _key(
        (0.0, 0.0), "true principal point less the known one, x and y, px: bias", [0.05, -0.02]
    )
    focal_length_error: Annotated[float, Field(ge=-0.1, le=0.1)] = _key(
        0.0, "true focal length over the known one, less 1", 1e-5
    )
    distortion_error_px: Annotated[float, Field(ge=-100.0, le=100.0)] = _key(
        0.0, "unknown distortion (k1) at the farthest corner, px", 0.05
    )
    catalog_error_arcsec: Annotated[float, Field(ge=0.0, le=60.0)] = _key(
        0.0,
        "error of a position on each axis at the epoch of the mission, standard deviation, arcsec",
        0.05,
    )
    velocity_error_km_s: Annotated[float, Field(ge=0.0, le=1000.0)] = _key(
        0.0,
        "error of the velocity that aberration is corrected with, standard deviation on each axis, "
        "km/s",
        0.01,
    )
    rates_deg_s: Annotated[tuple[Rate, ...], Several] = _key(
        (0.0, 0.1, 0.5, 1.0), "rates across the boresight, deg/s"
    )
    false_stars: Annotated[tuple[Spots, ...], Several] = _key(
        (5, 20), "false stars in a frame, as bright as guide stars"
    )
    missing_shares: Annotated[tuple[Share, ...], Several] = _key(
        (0.1, 0.3), "shares of the stars that are missing"
    )
    radiation_cm2_s: Annotated[tuple[Flux, ...], Several] = _key(
        (100.0, 1000.0), "particles that leave a spot, per cm2 and s"
    )
    radiation_e: Positive = _key(3000.0, "mean charge of a particle (exponential), electrons")
    radiation_track_px: Annotated[float, Field(ge=0.0, le=1000.0)] = _key(
        3.0, "mean length of a track (exponential), px"
    )
    exclusion_deg: tuple[Angle, Angle, Angle] = _key(
        (30.0, 25.0, 15.0), "angles of exclusion of Sun, Earth, Moon, deg: for 42"
    )
    confidence: Annotated[float, Field(gt=0.5, lt=1.0)] = _key(
        0.997, "confidence at which errors are stated"
    )

    @model_validator(mode="after")
    def _light_said_once(self) -> Sensor:
        optics = (self.aperture_mm, self.quantum_efficiency)
        is_whole = None not in optics
        if (self.zero_point_e_s is None) != is_whole or optics.count(None) == 1:
            raise ValueError(
                "the light: give either zero_point_e_s, or both aperture_mm and quantum_efficiency"
            )
        return self

    @property
    def zero_point_e(self) -> float:
        """Electrons of a star of magnitude 0 in a frame."""
        if self.zero_point_e_s is not None:
            return self.zero_point_e_s * self.exposure_s
        optics = (self.aperture_mm or 0.0, self.quantum_efficiency or 0.0)
        return zero_point_e_s(*optics, self.photons_s_mm2) * self.exposure_s

    @property
    def background_e(self) -> float:
        """Mean electrons of a pixel without stars in a frame."""
        return (self.dark_e_s + self.sky_e_s) * self.exposure_s


def read_sensor(path: Path) -> Sensor:
    """Read a sensor from a TOML file."""
    content = content_of_toml(
        text_of_toml(path, "no such sensor; 'starcat evaluate --ecss-example' prints one"),
        str(path),
    )
    return sensor_from(content, str(path))


def sensor_from(content: dict[str, Any], origin: str) -> Sensor:
    """Check a sensor that is already parsed."""
    whole = {
        key: tuple(value) if isinstance(value, list) else value for key, value in content.items()
    }
    try:
        return Sensor.model_validate(whole)
    except ValidationError as error:
        raise what_is_wrong(error, origin, Sensor, "sensor") from error


def sensor_toml(sensor: Sensor) -> str:
    """Return the keys of a sensor that differ from their defaults, as TOML."""
    changed = sensor.model_dump(mode="json", exclude_defaults=True)
    return "".join(f"{name} = {toml_value(value)}\n" for name, value in changed.items())


def example_toml() -> str:
    """Return a sensor with every key explained: its meaning, unit and default."""
    lines = ["# A star sensor: starcat evaluate DATABASE --ecss SENSOR.toml"]
    for name, field in Sensor.model_fields.items():
        text, value = str(field.description), (field.examples or [field.default])[0]
        if field.is_required():
            text += " (required)"
        elif "default" not in text:
            text += f" (default: {_text(field.default)})"
        lines += ["", *(f"# {line}" for line in textwrap.wrap(text, 94))]
        lines.append(f"{'# ' * (name in LEFT_OUT)}{name} = {_text(value)}")
    return "\n".join(lines) + "\n"


def _text(value: Any) -> str:
    return "none" if value is None else toml_value(value)
