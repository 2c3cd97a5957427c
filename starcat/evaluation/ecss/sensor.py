"""A star sensor as TOML: what turns the light of stars into electrons, and what is not known of it.

The optics, the size of the detector and the stars are those of an artifact.
"""

from __future__ import annotations

import math
import textwrap
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, ValidationError, model_validator

from starcat.specs.keys import toml_value
from starcat.specs.product_sections import Mag, Section
from starcat.specs.reading import content_of_toml, text_of_toml, what_is_wrong

Share = Annotated[float, Field(ge=0.0, le=1.0)]
Size = Annotated[float, Field(ge=0.0, le=1e9)]
Signed = Annotated[float, Field(ge=-1e6, le=1e6)]
Rate = Annotated[float, Field(ge=0.0, le=30.0)]
Angle = Annotated[float, Field(ge=0.0, le=180.0)]
Flux = Annotated[float, Field(ge=0.0, le=1e7)]
Spots = Annotated[int, Field(ge=0, le=1000)]
Triple = tuple[Signed, Signed, Signed]

NONE_KNOWN: Triple = (0.0, 0.0, 0.0)


class Sensor(Section):
    """A star sensor."""

    # light
    zero_point_e_s: float | None = Field(
        None, gt=0.0, le=1e15,
        description="electrons/s of a star of magnitude 0 in the band of the artifact; or else "
        "aperture_mm and quantum_efficiency",
    )  # fmt: skip
    aperture_mm: float | None = Field(
        None, gt=0.0, le=2000.0, description="diameter of the aperture, mm", examples=[20.0]
    )
    quantum_efficiency: float | None = Field(
        None, gt=0.0, le=1.0, examples=[0.5],
        description="electrons per photon, transmission of the optics included",
    )  # fmt: skip
    photons_s_mm2: float = Field(
        38_200.0, gt=0.0, le=1e9,
        description="photons/s and mm2 of a star of magnitude 0; the default is Liebe's 19,100 "
        "electrons (2002) at a quantum efficiency of 0.5",
    )  # fmt: skip
    exposure_s: float = Field(gt=0.0, le=60.0, description="exposure, s", examples=[0.1])
    psf_sigma_px: float = Field(
        ge=0.3, le=10.0, description="standard deviation of the Gaussian spot, px", examples=[0.8]
    )
    pixel_um: float = Field(gt=0.0, le=1000.0, description="pixel, um", examples=[12.0])
    # detector
    read_noise_e: float = Field(ge=0.0, le=1e4, description="read noise, electrons", examples=[8.0])
    full_well_e: float = Field(
        gt=0.0, le=1e9, description="electrons that a pixel holds", examples=[50_000.0]
    )
    gain_e_adu: float = Field(
        gt=0.0, le=1e6, description="electrons of a step of the converter", examples=[12.5]
    )
    bits: int = Field(12, ge=6, le=16, description="bits of the converter")
    offset_adu: float = Field(50.0, ge=0.0, le=60_000.0, description="level without light, steps")
    dark_e_s: Size = Field(0.0, description="dark current of a pixel, electrons/s", examples=[50.0])
    sky_e_s: Size = Field(
        0.0, description="stray light and sky in a pixel, electrons/s", examples=[100.0]
    )
    prnu: Share = Field(
        0.0, description="photo response non-uniformity, standard deviation, share", examples=[0.01]
    )
    dsnu_e_s: Size = Field(
        0.0, description="dark signal non-uniformity, standard deviation, electrons/s",
        examples=[20.0],
    )  # fmt: skip
    hot_pixel_share: Share = Field(
        0.0, description="share of hot pixels at end of life, unknown to the sensor",
        examples=[0.001],
    )  # fmt: skip
    hot_pixel_e_s: Size = Field(
        20_000.0, description="mean dark current of a hot pixel (exponential), electrons/s"
    )
    # what the sensor does with a frame
    threshold_sigma: float = Field(
        5.0, ge=2.0, le=100.0, description="threshold of detection, standard deviations"
    )
    limit_mag: Mag | None = Field(
        None, description="fainter spots are not used, mag; default: 0.3 beyond the artifact's",
        examples=[6.3],
    )  # fmt: skip
    most_spots: int = Field(64, ge=4, le=10_000, description="brightest spots that are used")
    update_rate_hz: float = Field(gt=0.0, le=1000.0, description="frames/s", examples=[5.0])
    processing_s: float = Field(
        0.0, ge=0.0, le=600.0, description="from the end of an exposure to the attitude, s",
        examples=[0.2],
    )  # fmt: skip
    # what is not known
    alignment_arcsec: Triple = Field(
        NONE_KNOWN, description="error of the alignment about x, y, z, arcsec: bias",
        examples=[[5.0, -3.0, 10.0]],
    )  # fmt: skip
    thermo_elastic_arcsec: Triple = Field(
        NONE_KNOWN, description="thermo-elastic error about x, y, z, arcsec: reported as stated",
        examples=[[1.0, 1.0, 2.0]],
    )  # fmt: skip
    principal_point_error_px: tuple[Signed, Signed] = Field(
        (0.0, 0.0), description="true principal point less the known one, x and y, px: bias",
        examples=[[0.05, -0.02]],
    )  # fmt: skip
    focal_length_error: float = Field(
        0.0, ge=-0.1, le=0.1, description="true focal length over the known one, less 1",
        examples=[1e-5],
    )  # fmt: skip
    distortion_error_px: float = Field(
        0.0, ge=-100.0, le=100.0, description="unknown distortion (k1) at the farthest corner, px",
        examples=[0.05],
    )  # fmt: skip
    catalog_error_arcsec: float = Field(
        0.0, ge=0.0, le=60.0, description="error of a position on each axis at the epoch of the "
        "mission, standard deviation, arcsec", examples=[0.05],
    )  # fmt: skip
    velocity_error_km_s: float = Field(
        0.0, ge=0.0, le=1000.0, description="error of the velocity that aberration is corrected "
        "with, standard deviation on each axis, km/s", examples=[0.01],
    )  # fmt: skip
    # what it is tried with
    rates_deg_s: tuple[Rate, ...] = Field(
        (0.0, 0.1, 0.5, 1.0), max_length=8, description="rates across the boresight, deg/s"
    )
    false_stars: tuple[Spots, ...] = Field(
        (5, 20), max_length=8, description="false stars in a frame, as bright as guide stars"
    )
    missing_shares: tuple[Share, ...] = Field(
        (0.1, 0.3), max_length=8, description="shares of the stars that are missing"
    )
    radiation_cm2_s: tuple[Flux, ...] = Field(
        (100.0, 1000.0), max_length=8, description="particles that leave a spot, per cm2 and s"
    )
    radiation_e: float = Field(
        3000.0, gt=0.0, le=1e7, description="mean charge of a particle (exponential), electrons"
    )
    radiation_track_px: float = Field(
        3.0, ge=0.0, le=1000.0, description="mean length of a track (exponential), px"
    )
    exclusion_deg: tuple[Angle, Angle, Angle] = Field(
        (30.0, 25.0, 15.0), description="angles of exclusion of Sun, Earth, Moon, deg: for 42"
    )
    confidence: float = Field(
        0.997, gt=0.5, lt=1.0, description="confidence at which errors are stated"
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
        area_mm2 = 0.25 * math.pi * (self.aperture_mm or 0.0) ** 2
        electrons = area_mm2 * self.photons_s_mm2 * (self.quantum_efficiency or 0.0)
        return electrons * self.exposure_s

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
    whole = {key: tuple(one) if isinstance(one, list) else one for key, one in content.items()}
    try:
        return Sensor.model_validate(whole)
    except ValidationError as error:
        raise what_is_wrong(error, origin, Sensor, "sensor") from error


def sensor_toml(sensor: Sensor) -> str:
    """Return what a sensor has, but for what is as by default."""
    own = sensor.model_dump(mode="json", exclude_defaults=True)
    return "".join(f"{name} = {toml_value(value)}\n" for name, value in own.items())


def example_toml() -> str:
    """Return a sensor with every key explained: its meaning, unit and default."""
    lines = ["# A star sensor: starcat evaluate ARTIFACT --ecss SENSOR.toml"]
    for name, field in Sensor.model_fields.items():
        told = "required" if field.is_required() else f"default: {_text(field.default)}"
        text = (
            field.description
            if "default" in str(field.description)
            else (f"{field.description} ({told})")
        )
        value = field.examples[0] if field.examples else field.default
        lines += ["", *(f"# {line}" for line in textwrap.wrap(str(text), 94))]
        lines.append(f"# {name} = 6.0e7" if value is None else f"{name} = {_text(value)}")
    return "\n".join(lines) + "\n"


def _text(value: Any) -> str:
    return "none" if value is None else toml_value(value)
