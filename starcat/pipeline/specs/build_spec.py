"""The build spec: everything on which a database depends, except its input files.

Every key has a unit in its name, a range and a meaning, which ``docs/spec.md`` lists. The manifest
of the database contains the whole spec. `starcat.pipeline.specs.reading` reads a spec from a file.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from pydantic import Field, ValidationError, field_validator, model_validator

from starcat.catalog.stars.epochs import ends_of, middle_of
from starcat.database.products.kind import SpecFacts
from starcat.database.products.table import Products
from starcat.errors import AsWritten, ConfigError
from starcat.geometry.camera import Camera
from starcat.pipeline.selection.ruleset import Selection, check_rules
from starcat.pipeline.specs.camera_sensor import (
    CameraExposure,
    CameraResponse,
    contradiction,
    exposure_notes,
    exposure_proposal,
    with_limits,
)
from starcat.pipeline.specs.epoch import EpochOrSpan
from starcat.sections import (
    NAME_PATTERN,
    SOURCE_NAME,
    VERSION_PATTERN,
    CatalogName,
    FieldDeg,
    Mag,
    Section,
)
from starcat.storage.toml_files import toml_shown


class Catalog(Section):
    """Where the stars come from."""

    later_keys = ("merged", "motions")

    source: str = Field(
        pattern=SOURCE_NAME,
        description="name of a star catalog, as 'starcat sources' lists them",
        examples=["gaia"],
    )
    band: str | None = Field(
        None, description="band of the magnitudes; default: the source's first", examples=["G"]
    )
    read_limit_mag: Mag | None = Field(
        None, description="fainter records, and those without magnitude, are counted and left out"
    )
    merged: tuple[CatalogName, ...] = Field(
        (),
        strict=False,  # a list in TOML
        max_length=8,
        description="catalogs that add the stars which the source, and those named before, lack; "
        "their magnitudes become those of the source's band, found as [products.crossmatch] says",
        examples=[["tycho2", "gaia"]],
    )
    motions: tuple[CatalogName, ...] = Field(
        (),
        strict=False,  # a list in TOML
        description="catalogs that supply missing proper motions, in order of preference; found "
        "as [products.crossmatch] says",
        examples=[["tycho2"]],
    )

    @property
    def catalogs(self) -> tuple[str, ...]:
        """Names of the catalogs of the stars, the preferred catalog first."""
        return self.source, *self.merged

    @model_validator(mode="after")
    def _other_catalogs(self) -> Catalog:
        for key in ("merged", "motions"):
            if self.source in getattr(self, key):
                raise ValueError(
                    f"{key}: {self.source} is the catalog of the stars themselves; name others"
                )
        return self


FOR_OTHER_PIXELS = (
    "for pixels that are not square, scale the y coordinates of the frames, and {height_px}, by "
    "the height of a pixel over its width"
)


def check_one_side(pixel_um: Any) -> None:
    """Check that the size of a pixel is not two sides; `ConfigError` if it is."""
    is_text = isinstance(pixel_um, str)
    if isinstance(pixel_um, list | tuple) or (is_text and re.search(r"\d\s*[,;x*]\s*\d", pixel_um)):
        shown = pixel_um if is_text else toml_shown(list(pixel_um))
        raise ConfigError(f"found {shown}; expected one number", hint=FOR_OTHER_PIXELS)


class CameraSpec(Section):
    """The camera that the database is for: by its field of view, or by lens and pixel."""

    later_keys = ("readout_s",)
    not_keys: ClassVar[Mapping[str, str]] = {
        "fov_y_deg": "leave it out; it follows from {fov_x_deg}, {width_px} and {height_px}; "
        + FOR_OTHER_PIXELS
    }

    width_px: int = Field(ge=16, le=65536, description="width of the detector", examples=[1024])
    height_px: int = Field(ge=16, le=65536, description="height of the detector", examples=[1024])
    fov_x_deg: FieldDeg | None = Field(
        None, description="full angle across the width", examples=[12.0]
    )
    focal_length_mm: float | None = Field(
        None, ge=0.01, le=1e6, description="of the lens; goes with pixel_um", examples=[25.0]
    )
    pixel_um: float | None = Field(
        None, ge=0.01, le=1e4, description="side of a square pixel", examples=[5.5]
    )
    readout_s: float | None = Field(
        None,
        gt=0.0,
        le=1e3,
        description="from the exposure of the first row to that of the last one (rolling shutter); "
        "the database does not depend on it, and an answer states how fast the camera turned",
        examples=[0.05],
    )
    response: CameraResponse = CameraResponse()
    exposure: CameraExposure = CameraExposure()

    @field_validator("pixel_um", mode="before")
    @classmethod
    def _is_one_side(cls, value: Any) -> Any:
        check_one_side(value)
        return value

    @model_validator(mode="after")
    def _one_way_to_say_the_scale(self) -> CameraSpec:
        by_lens = (self.focal_length_mm is not None, self.pixel_um is not None)
        if (self.fov_x_deg is None) != all(by_lens) or any(by_lens) != all(by_lens):
            scales = "two scales" if self.fov_x_deg is not None else "half of a scale"
            raise ConfigError(
                f"found {scales if any(by_lens) else 'no scale'}",
                hint="give either {fov_x_deg}, or {focal_length_mm} and {pixel_um}",
            )
        if self.camera().fov_x_deg >= 120.0:
            raise ConfigError("the lens gives a field of 120 deg or more", hint="check its units")
        for name in ("fov_x_deg", "fov_y_deg"):
            angle = getattr(self.camera(), name)
            if not 0.001 <= angle < 150.0:
                raise ConfigError(
                    "a field is 0.001 to 150 deg wide",
                    parameter=name,
                    value=AsWritten(f"{angle:.4g}"),
                    hint="check the units",
                )
        return self

    @property
    def half_field_deg(self) -> float:
        """Half of the narrower full angle: the radius of the circle inside the field."""
        camera = self.camera()
        return 0.5 * min(camera.fov_x_deg, camera.fov_y_deg)

    def camera(self) -> Camera:
        """Return the camera."""
        if self.fov_x_deg is not None:
            focal_length_px = None
        else:
            focal_length_px = (self.focal_length_mm or 1.0) * 1000.0 / (self.pixel_um or 1.0)
        return Camera(
            self.width_px,
            self.height_px,
            focal_length_px,
            fov_x_deg=self.fov_x_deg,
            readout_s=self.readout_s,
        )


USUAL_BORESIGHTS, MAX_BORESIGHTS = 10_000, 1_000_000
"""Default and largest number of boresights."""


def least_boresights(half_field_deg: float) -> float:
    """Return the number of boresights whose fields leave no hole.

    With 10,000 Saff-Kuijlaars points no direction is farther than 1.50 deg from the nearest point;
    this distance is inversely proportional to the square root of their number.
    """
    return 1.05 * 10_000 * (1.5 / half_field_deg) ** 2


class Boresights(Section):
    """The tiling of the sphere."""

    count: int = Field(
        USUAL_BORESIGHTS,
        ge=1,
        le=MAX_BORESIGHTS,
        description="number of Saff-Kuijlaars points; default for fields narrower than 3 deg: as "
        "many as leave no hole between them",
    )
    fov_x_deg: FieldDeg | None = Field(
        None, description="width of the tiling's fields; default: the camera's"
    )
    fov_y_deg: FieldDeg | None = Field(
        None, description="height of the tiling's fields; default: the camera's"
    )
    field: Literal["rectangular", "circular"] = Field(
        "rectangular", description="the camera's frame at roll 0, or the circle inside it"
    )
    brightest: int = Field(8, ge=1, le=100, description="length of each field's list of stars")
    min_stars_per_field: int | None = Field(
        None, ge=1, le=10_000, description="the build fails if a field of the tiling has fewer"
    )


class SelfTest(Section):
    """Simulated fields that the finished database must identify."""

    frames: int = Field(200, ge=1, le=100_000, description="number of fields of each kind")
    seed: int = Field(20_000, ge=0, le=2**63 - 1, description="start of the random numbers")
    noise_px: float = Field(
        0.5, ge=0.0, le=50.0, description="noise of a centroid, standard deviation of each axis"
    )
    noise_mag: float = Field(
        0.2,
        ge=0.0,
        le=10.0,
        description="noise of the magnitude of a centroid, standard deviation; it decides what is "
        "tried first",
    )
    min_identified: float = Field(
        0.9,
        ge=0.0,
        le=1.0,
        description="least share of all pointings that is identified in clean frames; the build "
        "fails if the 95 % interval of the share ends below",
    )


class BuildSpec(Section):
    """Everything that a database depends on, but for its input files."""

    name: str = Field(
        pattern=NAME_PATTERN,
        description="name of the database: small letters, digits and hyphens",
        examples=["mycam"],
    )
    version: str = Field(
        pattern=VERSION_PATTERN,
        description="version of the data. Patch: other stars. Minor: a new product. Major: "
        "another layout, unit or frame",
        examples=["1.0.0"],
    )
    description: str = Field("", max_length=2000, description="what the database is for")
    epoch_jyear: EpochOrSpan = Field(
        description="Julian year of all positions, or a span [begin, end]: positions are then at "
        "its middle, and how far a star drifts to the ends is told",
        examples=[2026.0],
    )
    catalog: Catalog
    selection: Selection
    camera: CameraSpec
    boresights: Boresights = Boresights()
    products: Products = Products()
    self_test: SelfTest = SelfTest()

    @model_validator(mode="before")
    @classmethod
    def _limits_of_the_exposure(cls, content: Any) -> Any:
        return with_limits(content)

    @model_validator(mode="before")
    @classmethod
    def _boresights_of_narrow_fields(cls, content: Any) -> Any:
        return _with_boresights(content)

    @model_validator(mode="after")
    def _limits_said_once(self) -> BuildSpec:
        limits = self.camera.exposure.limits(self.camera.response.response())
        problem = contradiction(limits, {key: getattr(self.selection, key) for key in limits})
        if problem:
            raise ValueError(problem)
        return self

    @model_validator(mode="after")
    def _stars_up_to_the_limits_are_read(self) -> BuildSpec:
        if not self._limits_are_of_one_band:
            return self
        for words in self._limits_beyond_reading:
            raise ValueError(words)
        return self

    @property
    def _limits_are_of_one_band(self) -> bool:
        """Whether the selection uses the magnitudes by which the catalog is read."""
        return self.camera.response.name is None and not self.selection.observed.colour_term

    @property
    def _limits_beyond_reading(self) -> tuple[str, ...]:
        """Messages about limits of the selection that are fainter than the stars that are read."""
        read_mag, doubles = self.catalog.read_limit_mag, self.selection.doubles
        limits = {
            "selection.faint_limit_mag": self.selection.faint_limit_mag,
            "selection.doubles.companion_limit_mag": doubles.companion_limit_mag,
        }
        return tuple(
            f"catalog.read_limit_mag {read_mag:g} is brighter than {key} {mag:g}: the stars "
            "between the two are not read. Give a fainter read_limit_mag, or leave it out"
            for key, mag in limits.items()
            if read_mag is not None and mag is not None and read_mag < mag
        )

    @model_validator(mode="after")
    def _rules_of_selection_agree(self) -> BuildSpec:
        check_rules(self)
        return self

    @model_validator(mode="after")
    def _photometry_of_other_catalogs(self) -> BuildSpec:
        if self.catalog.source in self.camera.response.photometry:
            raise ValueError(
                f"camera.response.photometry: {self.catalog.source} is the catalog of the stars "
                "themselves; name others"
            )
        return self

    @model_validator(mode="after")
    def _one_band_of_merged_catalogs(self) -> BuildSpec:
        if self.catalog.merged and self.camera.response.name is not None:
            raise ValueError(
                "catalog.merged: the stars have colours of several catalogs, which give no "
                "magnitudes in a sensor's band; leave [camera.response] out, or build from one "
                "catalog"
            )
        return self

    @model_validator(mode="after")
    def _products_agree(self) -> BuildSpec:
        facts = SpecFacts(
            self.catalog.source,
            self.camera.camera(),
            self.camera.half_field_deg,
            tuple(self.products.requested),
        )
        for section in self.products.sections.values():
            section.check_agrees(facts)
        return self

    @property
    def limit_notes(self) -> tuple[str, ...]:
        """Notes about pairs of limits that leave something out which the spec seems to want."""
        crossmatch, faint_mag = self.products.crossmatch, self.selection.faint_limit_mag
        notes = () if self._limits_are_of_one_band else self._limits_beyond_reading
        read_mag = crossmatch.read_limit_mag
        if crossmatch.enabled and read_mag is not None and read_mag < faint_mag:
            notes += (
                f"products.crossmatch.read_limit_mag {read_mag:g} is brighter than "
                f"selection.faint_limit_mag {faint_mag:g}: counterparts of the faintest guide "
                "stars are not read, unless their band makes them that much brighter",
            )
        grid = self.products.grid
        radius_deg = grid.radius_deg or self.camera.half_field_deg
        if grid.enabled and grid.buffer_deg >= radius_deg:
            notes += (
                f"products.grid.buffer_deg {grid.buffer_deg:g} is not below the radius of a "
                f"pattern, {radius_deg:.4g} deg, so that the product is empty: make it smaller, or "
                "set products.grid.enabled = false",
            )
        return notes

    @property
    def exposure_proposal(self) -> tuple[str, ...]:
        """The limits that the camera's exposure proposes."""
        return exposure_proposal(self.camera.exposure, self.camera.response.response())

    @property
    def exposure_notes(self) -> tuple[str, ...]:
        """Notes about a limit that is fainter than the camera's exposure allows."""
        response = self.camera.response.response()
        return exposure_notes(self.camera.exposure, response, self.selection.faint_limit_mag)

    @property
    def span_jyear(self) -> tuple[float, float]:
        """The first and the last Julian year of the database's span, often the same."""
        return ends_of(self.epoch_jyear)

    @property
    def middle_jyear(self) -> float:
        """Julian year of all positions."""
        return middle_of(self.epoch_jyear)

    @property
    def joins(self) -> tuple[str, ...]:
        """Names of the sources of doubles and variables, in the order of joining."""
        return *self.selection.variables.join, *self.selection.doubles.join

    @property
    def fields_deg(self) -> tuple[float, float]:
        """Narrowest and widest horizontal field of view that the database is for."""
        own_deg = self.camera.camera().fov_x_deg
        return own_deg, max(
            each.widest_field_deg(own_deg) for each in self.products.sections.values()
        )

    @property
    def is_for_a_range(self) -> bool:
        """Whether the database serves fields of view that are wider than the camera's."""
        narrowest, widest = self.fields_deg
        return widest > narrowest

    @property
    def sources(self) -> tuple[str, ...]:
        """Names of all sources that the build reads, the stars' first, without duplicates."""
        names = [*self.catalog.catalogs, *self.catalog.motions, *self.joins]
        names += self.camera.response.photometry
        for section in self.products.sections.values():
            names += section.sources
        return tuple(dict.fromkeys(names))

    def __repr__(self) -> str:
        camera = self.camera.camera()
        return (
            f"<BuildSpec {self.name}-{self.version}: {self.catalog.source} to "
            f"{self.selection.faint_limit_mag:g} mag, {camera.width_px} x {camera.height_px} px, "
            f"{camera.fov_x_deg:.4g} x {camera.fov_y_deg:.4g} deg>"
        )

    __str__ = __repr__


def _with_boresights(content: Any) -> Any:
    """Return the content of a spec with the number of boresights that its narrow fields need."""
    if not isinstance(content, dict) or not isinstance(content.get("camera"), dict):
        return content
    stated = content.get("boresights", {})
    if not isinstance(stated, dict) or "count" in stated:
        return content
    try:
        camera, tiling = (
            CameraSpec.model_validate(content["camera"]),
            Boresights.model_validate(stated),
        )
    except ValidationError:
        return content  # the check of the sections will report the error with its key
    eye = camera.camera()
    narrower_deg = min(tiling.fov_x_deg or eye.fov_x_deg, tiling.fov_y_deg or eye.fov_y_deg)
    count = 100 * math.ceil(least_boresights(0.5 * narrower_deg) / 100.0)
    if count <= USUAL_BORESIGHTS:
        return content
    return {**content, "boresights": {**stated, "count": min(count, MAX_BORESIGHTS)}}
