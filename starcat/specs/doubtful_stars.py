"""The sections of a build spec about stars that are several, or whose brightness varies."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from starcat.sections import Mag, Section


class Doubles(Section):
    """Stars too close for the sensor to tell apart."""

    later_keys = ("join",)

    min_separation_deg: float = Field(
        0.047, ge=0.0, le=10.0, description="stars that are closer are a double"
    )
    max_delta_mag: float | None = Field(
        None,
        ge=0.0,
        le=30.0,
        description="a companion fainter by more does not count; default: every one counts",
    )
    companion_limit_mag: Mag | None = Field(
        None,
        description="only stars up to this magnitude form doubles, as either of the two; "
        "default: faint_limit_mag",
    )
    action: Literal["remove", "merge", "keep"] = Field(
        "remove", description="remove both, merge them into their photocentre, or keep them"
    )
    flags: Literal["ignore", "unresolved", "strict"] = Field(
        "unresolved",
        description="what an archive's flag of a double means: nothing; a rejection if the "
        "separation is below the limit or unknown and the magnitudes are known to be close; or "
        "always a rejection",
    )
    join: tuple[Literal["wds"], ...] = Field(
        (),
        strict=False,  # a list in TOML
        max_length=1,
        description="sources that flag stars with a companion closer than min_separation_deg, by "
        "HIP number or place; a pair without magnitudes counts as one of equal stars where it is "
        "closer than 5 arcsec, and not at all where it is wider",
        examples=[["wds"]],
    )


class Variables(Section):
    """Stars whose brightness cannot be relied on."""

    max_amplitude_mag: float | None = Field(
        0.6, ge=0.0, le=30.0, description="stars with a larger amplitude are rejected"
    )
    flags: Literal["ignore", "known", "strict"] = Field(
        "ignore",
        description="what an archive's flag of a variable means: nothing; a rejection of those "
        "without a known amplitude; or always a rejection",
    )
    join: tuple[Literal["hipparcos", "tycho1", "gcvs", "vsx"], ...] = Field(
        (),
        strict=False,  # a list in TOML
        description="sources whose amplitudes are joined by HIP, HD, TYC or Gaia number, or (vsx) "
        "by place",
        examples=[["hipparcos"]],
    )
