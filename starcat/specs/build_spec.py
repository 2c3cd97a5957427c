"""BuildSpec: one TOML file says everything that a database depends on.

The spec is checked before anything is read: every key has a unit in its name and a range,
and an unknown key is refused with the nearest known name. It travels whole in the manifest.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    model_validator,
)

from starcat.errors import ConfigError, suggest
from starcat.geometry.camera import Camera
from starcat.resources import resource_folder
from starcat.specs.version import NAME_PATTERN, VERSION_PATTERN

Mag = Annotated[float, Field(ge=-30.0, le=40.0)]


class _Section(BaseModel):
    """Frozen; refuses unknown keys, wrong types and numbers that are not finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class Catalog(_Section):
    """Where the stars come from."""

    source: str = Field(description="name of a star catalog of data_sources")
    band: str | None = Field(None, description="band of the magnitudes; the source's first")
    read_limit_mag: Mag | None = Field(
        None, description="fainter records are rejected while reading and are nobody's neighbour"
    )


class Doubles(_Section):
    """Stars too close for the sensor to tell apart."""

    min_separation_deg: float = Field(0.047, ge=0.0, le=10.0, description="closer is a double")
    max_delta_mag: float | None = Field(
        None,
        ge=0.0,
        le=30.0,
        description="a companion fainter by more does not count; none: all do",
    )
    companion_limit_mag: Mag | None = Field(
        None, description="stars up to here count as companions; default faint_limit_mag"
    )
    action: Literal["remove", "merge", "keep"] = Field(
        "remove", description="remove both, merge into the photocentre, or keep"
    )
    flags: Literal["ignore", "unresolved", "strict"] = Field(
        "unresolved",
        description="archive flags: ignore; reject if the separation is below the limit or "
        "unknown and the magnitudes are known to be close; or reject every flagged star",
    )


class Variables(_Section):
    """Stars whose brightness cannot be relied on."""

    max_amplitude_mag: float | None = Field(
        0.6, ge=0.0, le=30.0, description="larger amplitudes are rejected; none: no limit"
    )
    flags: Literal["ignore", "known", "strict"] = Field(
        "ignore",
        description="flagged stars: ignore the flag; reject those without a known amplitude; "
        "or reject all",
    )
    join: tuple[Literal["hipparcos", "tycho1", "gcvs"], ...] = Field(
        (),
        strict=False,  # a list in TOML
        description="sources whose amplitudes are joined by HIP, HD, TYC or Gaia number",
    )


class Selection(_Section):
    """Which stars become guide stars."""

    bright_limit_mag: Mag = Field(-30.0, description="brighter is rejected")
    faint_limit_mag: Mag = Field(description="fainter is rejected; the limit itself is kept")
    max_stars: int | None = Field(None, ge=1, description="keep only this many, the brightest")
    max_stars_per_field: int | None = Field(
        None,
        ge=1,
        le=10_000,
        description="thin to an even density: keep the stars that are among the brightest this "
        "many of some field of the tiling",
    )
    doubles: Doubles = Doubles()
    variables: Variables = Variables()

    @model_validator(mode="after")
    def _limits_in_order(self) -> Selection:
        if self.bright_limit_mag >= self.faint_limit_mag:
            raise ValueError(
                f"bright_limit_mag {self.bright_limit_mag} is not below faint_limit_mag "
                f"{self.faint_limit_mag}: larger is fainter, so they may be swapped"
            )
        return self


class CameraSpec(_Section):
    """The camera that the database is for."""

    width_px: int = Field(ge=16, le=65536)
    height_px: int = Field(ge=16, le=65536)
    fov_x_deg: float | None = Field(None, gt=0.0, lt=120.0, description="full angle, width")
    focal_length_mm: float | None = Field(None, gt=0.0)
    pixel_um: float | None = Field(None, gt=0.0, description="square pixels")

    @model_validator(mode="after")
    def _one_way_to_say_the_scale(self) -> CameraSpec:
        by_lens = (self.focal_length_mm is not None, self.pixel_um is not None)
        if (self.fov_x_deg is None) != all(by_lens) or any(by_lens) != all(by_lens):
            raise ValueError("give either fov_x_deg, or focal_length_mm and pixel_um")
        if self.fov_x_deg is None and self.camera().fov_x_deg >= 120.0:
            raise ValueError("the lens gives a field of 120 deg or more; check its units")
        return self

    def camera(self) -> Camera:
        """Return the camera.

        Returns
        -------
        Camera
            With its focal length in pixels.
        """
        if self.fov_x_deg is not None:
            return Camera(self.width_px, self.height_px, fov_x_deg=self.fov_x_deg)
        focal_length_px = (self.focal_length_mm or 1.0) * 1000.0 / (self.pixel_um or 1.0)
        return Camera(self.width_px, self.height_px, focal_length_px)


class Boresights(_Section):
    """The tiling of the sphere."""

    count: int = Field(10_000, ge=1, le=1_000_000, description="Saff-Kuijlaars points")
    fov_x_deg: float | None = Field(
        None, gt=0.0, lt=120.0, description="of the tiling's fields; default: the camera's"
    )
    fov_y_deg: float | None = Field(None, gt=0.0, lt=120.0)
    field: Literal["rectangular", "circular"] = Field(
        "rectangular", description="the camera's frame at roll 0, or the circle inside it"
    )
    brightest: int = Field(8, ge=1, le=100, description="length of each field's list of stars")
    min_stars_per_field: int | None = Field(
        None, ge=1, le=10_000, description="the build fails if a field of the tiling has fewer"
    )


class _Product(_Section):
    """A product that can be left out."""

    enabled: bool = True


class Pairs(_Product):
    """Star pairs and their K-vector."""

    min_separation_deg: float = Field(0.0, ge=0.0, le=180.0)
    max_separation_deg: float | None = Field(
        None, gt=0.0, le=180.0, description="default: the field's diagonal"
    )


class Triangles(_Product):
    """Triangles of the brightest stars of each boresight's field (S4)."""


class Neighbours(_Product):
    """Angles and separations of each star's neighbours, with a look-up table (S2)."""

    radius_deg: float | None = Field(
        None, gt=0.0, le=90.0, description="default: half of the narrower field"
    )
    angle_bin_deg: float = Field(2.0, gt=0.0, le=360.0)
    separation_bin_deg: float = Field(0.1, gt=0.0, le=90.0)


class HausdorffAngular(_Product):
    """Separations around each star (S5)."""

    radius_deg: float | None = Field(
        None, gt=0.0, le=90.0, description="default: 4/3 of half of the narrower field"
    )


class HausdorffL2(_Product):
    """Planar distances around each star over the smallest one (S1)."""

    radius_deg: float | None = Field(
        None, gt=0.0, le=80.0, description="default: half of the narrower field"
    )


class Grid(_Product):
    """Bit patterns of the grid method."""

    radius_deg: float | None = Field(
        None, gt=0.0, le=80.0, description="default: half of the narrower field"
    )
    buffer_deg: float = Field(0.3, ge=0.0, le=80.0, description="no alignment star nearer")
    cells_per_side: int = Field(40, ge=2, le=1000)


class Radial(_Product):
    """Ring and sector features of the radial and cyclic method."""

    radius_deg: float | None = Field(
        None, gt=0.0, le=90.0, description="default: half of the narrower field"
    )
    rings: int = Field(60, ge=1, le=10_000)
    sectors: int = Field(16, ge=1, le=30)


class Crossmatch(_Product):
    """Counterparts of the guide stars in other catalogs."""

    enabled: bool = False
    catalogs: tuple[Literal["sao", "hipparcos", "tycho1", "tycho2", "2mass", "gaia"], ...] = Field(
        (),
        strict=False,  # a list in TOML
        description="star catalogs to look for counterparts in",
    )
    radius_arcsec: float = Field(
        10.0, gt=0.0, le=600.0, description="largest separation of a candidate"
    )
    position_error_arcsec: float | None = Field(
        None,
        gt=0.0,
        le=60.0,
        description="standard deviation of the difference of two positions of a star, each axis; "
        "default: measured",
    )
    unknown_motion_mas_yr: float = Field(
        20.0,
        ge=0.0,
        le=10_000.0,
        description="standard deviation of the motion of a pair in which neither has one",
    )
    outlier_share: float = Field(
        0.02, ge=0.0, lt=1.0, description="of the stars, off by more than errors explain"
    )
    expected_delta_mag: Mag | None = Field(
        None, description="magnitude of the counterpart minus the star's; default: measured"
    )
    colour_spread_mag: float = Field(
        1.0, gt=0.0, le=30.0, description="standard deviation of that difference"
    )
    completeness: float | None = Field(
        None, gt=0.0, lt=1.0, description="share of stars with a counterpart; default: measured"
    )
    ambiguous_odds: float = Field(
        10.0, ge=1.0, description="candidates that differ by no more are ambiguous"
    )
    min_probability: float = Field(
        0.5, ge=0.0, le=1.0, description="candidates that together have less are doubtful"
    )
    read_limit_mag: Mag | None = Field(
        None, description="fainter counterparts are rejected while reading"
    )

    @model_validator(mode="after")
    def _catalogs_once_each(self) -> Crossmatch:
        if self.enabled and not self.catalogs:
            raise ValueError('no catalogs; name some, such as catalogs = ["hipparcos"]')
        if len(set(self.catalogs)) != len(self.catalogs):
            raise ValueError(f"a catalog is named twice: {', '.join(self.catalogs)}")
        return self


class Products(_Section):
    """Which products the artifact holds, and their parameters."""

    pairs: Pairs = Pairs()
    triangles: Triangles = Triangles()
    neighbours: Neighbours = Neighbours()
    hausdorff_angular: HausdorffAngular = HausdorffAngular()
    hausdorff_l2: HausdorffL2 = HausdorffL2()
    grid: Grid = Grid()
    radial: Radial = Radial()
    crossmatch: Crossmatch = Crossmatch()


class SelfTest(_Section):
    """Simulated fields that the finished database must identify."""

    frames: int = Field(200, ge=1, le=100_000)
    seed: int = Field(20_000, ge=0)
    noise_px: float = Field(0.5, ge=0.0, le=50.0, description="standard deviation per axis")
    min_identified: float = Field(
        0.9, ge=0.0, le=1.0, description="share of the fields with at least 4 stars"
    )


class BuildSpec(_Section):
    """Everything that a database depends on, but for its input files."""

    name: str = Field(pattern=NAME_PATTERN)
    version: str = Field(pattern=VERSION_PATTERN, description="of the data: semantic")
    description: str = ""
    epoch_jyear: float = Field(ge=1800.0, le=2200.0, description="Julian year of all positions")
    catalog: Catalog
    selection: Selection
    camera: CameraSpec
    boresights: Boresights = Boresights()
    products: Products = Products()
    self_test: SelfTest = SelfTest()

    @model_validator(mode="after")
    def _counterparts_in_other_catalogs(self) -> BuildSpec:
        if self.catalog.source in self.products.crossmatch.catalogs:
            raise ValueError(
                f"products.crossmatch.catalogs: {self.catalog.source} is the catalog of the stars "
                "themselves; name others"
            )
        return self

    @property
    def sources(self) -> tuple[str, ...]:
        """Names of all sources that the build reads, the stars' first, each once."""
        wanted = self.products.crossmatch
        names = [self.catalog.source, *self.selection.variables.join]
        return tuple(dict.fromkeys([*names, *(wanted.catalogs if wanted.enabled else ())]))


def read_spec(path: Path) -> BuildSpec:
    """Read a build spec from a TOML file.

    Parameters
    ----------
    path : Path
        The file.

    Returns
    -------
    BuildSpec
        Checked.

    Raises
    ------
    ConfigError
        If the file is missing or not TOML, or a key is unknown, missing or out of range.
    """
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError(
            f"{path}: no such spec; 'starcat presets' lists those that ship with starcat"
        ) from None
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(f"{path}: not a readable TOML file: {error}") from error
    return spec_from_dict(content, path.name)


def spec_from_dict(content: dict[str, Any], origin: str) -> BuildSpec:
    """Check a spec that is already parsed.

    Parameters
    ----------
    content : dict
        Keys as in the TOML file.
    origin : str
        Where it is from, for messages.

    Returns
    -------
    BuildSpec
        Checked.

    Raises
    ------
    ConfigError
        Naming the first wrong key, what was found and what is allowed.
    """
    try:
        return BuildSpec.model_validate(content)
    except ValidationError as error:
        # A misspelt key is missing too: the spelling is what helps.
        wrong = sorted(error.errors(), key=lambda entry: entry["type"] != "extra_forbidden")
        first = wrong[0]
        names = (str(part) for part in first["loc"])
        key = ".".join(name if name.isprintable() else repr(name) for name in names) or "spec"
        raise ConfigError(
            f"{origin}: {key}: {_explain(dict(first))}", key=key, value=first["input"]
        ) from error


def _explain(error: dict[str, Any]) -> str:
    kind, context = error["type"], error.get("ctx", {})
    if kind == "extra_forbidden":
        known = _known_keys(error["loc"][:-1])
        hint = suggest(str(error["loc"][-1]), known)
        return f"unknown key; {hint}known keys here: {', '.join(known)}"
    if kind == "missing":
        return "missing; every spec needs it"
    if kind == "value_error":
        return str(context.get("error", error["msg"]))
    found = repr(error["input"])
    return f"found {found if len(found) < 60 else found[:57] + '...'}; {error['msg']}"


def _known_keys(location: tuple[Any, ...]) -> list[str]:
    model: Any = BuildSpec
    for part in location:
        model = model.model_fields[part].annotation
    return sorted(model.model_fields)


def preset_names() -> tuple[str, ...]:
    """Return the names of the presets that ship with starcat, the default first.

    Returns
    -------
    tuple of str
        Names.

    Examples
    --------
    >>> preset_names()[0]
    'gaia-12deg'
    """
    names = sorted(path.stem for path in resource_folder("specs/presets").glob("*.toml"))
    return tuple(sorted(names, key=lambda name: (name != "gaia-12deg", name)))


def preset(name: str) -> BuildSpec:
    """Return a preset.

    Parameters
    ----------
    name : str
        One of `preset_names`.

    Returns
    -------
    BuildSpec
        Checked.

    Raises
    ------
    ConfigError
        If there is none of that name, with the nearest that there is.
    """
    if name not in preset_names():
        hint = suggest(name, preset_names())
        raise ConfigError(
            f"unknown preset {name!r}; {hint}known presets: {', '.join(preset_names())}",
            key="preset",
            value=name,
        )
    return read_spec(resource_folder("specs/presets") / f"{name}.toml")
