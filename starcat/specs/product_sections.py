"""Sections of a spec about products and their parameters."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from starcat.sections import FieldDeg, Mag, PlanarDeg, Section, SmallDeg

_HALF_FIELD = "default: half of the camera's narrower field"


class Product(Section):
    """A product that can be left out."""

    enabled: bool = Field(True, description="whether the database has this product")


class Pairs(Product):
    """Star pairs and their K-vector."""

    min_separation_deg: float = Field(
        0.0, ge=0.0, le=180.0, description="pairs that are closer are left out"
    )
    max_separation_deg: float | None = Field(
        None, ge=0.001, le=180.0, description="pairs up to here; default: the field's diagonal"
    )

    @model_validator(mode="after")
    def _limits_in_order(self) -> Pairs:
        most = self.max_separation_deg
        if most is not None and self.min_separation_deg >= most:
            raise ValueError(
                f"min_separation_deg {self.min_separation_deg} is not below max_separation_deg "
                f"{most}; swap them"
            )
        return self


class Triangles(Product):
    """Triangles of the brightest stars of each boresight's field (S4)."""


class Neighbours(Product):
    """Angles and separations of each star's neighbours, with a look-up table (S2)."""

    radius_deg: SmallDeg | None = Field(
        None, description=f"how far a neighbour may be; {_HALF_FIELD}"
    )
    angle_bin_deg: float = Field(
        2.0, ge=0.1, le=360.0, description="width of the look-up table's bins in angle"
    )
    separation_bin_deg: SmallDeg = Field(
        0.1, description="width of the look-up table's bins in separation"
    )


class HausdorffAngular(Product):
    """Separations around each star (S5)."""

    radius_deg: SmallDeg | None = Field(
        None,
        description="how far a star of the set may be; default: 4/3 of half of the narrower field",
    )


class HausdorffL2(Product):
    """Planar distances around each star over the smallest one (S1)."""

    radius_deg: PlanarDeg | None = Field(
        None, description=f"how far a star of the set may be; {_HALF_FIELD}"
    )


class Grid(Product):
    """Bit patterns of the grid method."""

    radius_deg: PlanarDeg | None = Field(
        None, description=f"half the side of the pattern; {_HALF_FIELD}"
    )
    buffer_deg: float = Field(
        0.3, ge=0.0, le=80.0, description="the star that turns the pattern is not nearer than this"
    )
    cells_per_side: int = Field(40, ge=2, le=1000, description="cells along one side")


class Radial(Product):
    """Ring and sector features of the radial and cyclic method."""

    radius_deg: SmallDeg | None = Field(
        None, description=f"how far a star of the pattern may be; {_HALF_FIELD}"
    )
    rings: int = Field(60, ge=1, le=10_000, description="rings between the star and the radius")
    sectors: int = Field(16, ge=1, le=30, description="sectors of the full turn")


class Levels(Product):
    """Stars and triangles for fields wider than the camera's: one database for a range of them."""

    is_later = True

    enabled: bool = Field(False, description="whether the database has this product")
    widest_fov_x_deg: FieldDeg = Field(
        30.0, description="largest field across the width; the range begins at the camera's own"
    )
    max_ratio: float = Field(
        1.5, ge=1.1, le=2.0, description="largest ratio of the fields of neighbouring levels"
    )
    stars_per_field: int = Field(
        20, ge=4, le=10_000, description="number of stars of each field of a level, the brightest"
    )


class Crossmatch(Product):
    """Counterparts of the guide stars in other catalogs."""

    enabled: bool = Field(False, description="whether the database has this product")
    catalogs: tuple[
        Literal["sao", "hipparcos", "hipparcos2", "tycho1", "tycho2", "2mass", "gaia"], ...
    ] = Field(
        (),
        strict=False,  # a list in TOML
        description="star catalogs to look for counterparts in",
        examples=[["hipparcos"]],
    )
    radius_arcsec: float = Field(
        10.0, ge=0.001, le=600.0, description="largest separation of a candidate"
    )
    position_error_arcsec: float | None = Field(
        None,
        ge=0.0001,
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
        0.02,
        ge=0.0,
        le=0.99,
        description="share of the stars that are off by more than their stated errors",
    )
    expected_delta_mag: Mag | None = Field(
        None, description="magnitude of the counterpart minus the star's; default: measured"
    )
    colour_spread_mag: float = Field(
        1.0, ge=0.01, le=30.0, description="standard deviation of that difference"
    )
    completeness: float | None = Field(
        None, ge=0.001, le=0.999, description="share of stars with a counterpart; default: measured"
    )
    ambiguous_odds: float = Field(
        10.0, ge=1.0, le=1e6, description="candidates that differ by no more are ambiguous"
    )
    min_probability: float = Field(
        0.5, ge=0.0, le=1.0, description="candidates that together have less are doubtful"
    )
    read_limit_mag: Mag | None = Field(
        None, description="fainter counterparts are counted while reading, not listed"
    )

    @model_validator(mode="after")
    def _catalogs_once_each(self) -> Crossmatch:
        if self.enabled and not self.catalogs:
            raise ValueError('no catalogs; name some, such as catalogs = ["hipparcos"]')
        if len(set(self.catalogs)) != len(self.catalogs):
            raise ValueError(f"a catalog is named twice: {', '.join(self.catalogs)}")
        return self


class Products(Section):
    """Which products the database holds, and their parameters."""

    pairs: Pairs = Pairs()
    triangles: Triangles = Triangles()
    neighbours: Neighbours = Neighbours()
    hausdorff_angular: HausdorffAngular = HausdorffAngular()
    hausdorff_l2: HausdorffL2 = HausdorffL2()
    grid: Grid = Grid()
    radial: Radial = Radial()
    levels: Levels = Levels()
    crossmatch: Crossmatch = Crossmatch()
