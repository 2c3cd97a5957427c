"""Named profiles of onboard images: what an image keeps of a database.

docs/onboard-format.md has the bytes, identification rates and steps that they were chosen by.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from starcat.errors import ConfigError


@dataclass(frozen=True)
class Profile:
    """What an image keeps, as shares of all triangles or pairs.

    The triangles that are seen most often are kept until the sum of their ``times_seen`` is this
    share of the sum over all triangles. Pairs are kept up to this share of the longest separation.
    """

    # For each method of the image, the first of which is the default: the part that is kept of all
    # triangles or pairs even if the image is still too large for ``max_bytes``.
    least: Mapping[str, float]
    most: float = 1.0  # the part that is kept if the image is not too large
    # Stars are kept if they are among this many brightest of any field; None: all stars.
    stars_per_field: int | None = None
    stars_per_cell: int = 1  # average of the grid

    @property
    def methods(self) -> tuple[str, ...]:
        """Methods that the profile has images for, the default one first."""
        return tuple(self.least)


FULL = Profile(MappingProxyType({"triangle": 1.0 / 3.0, "pyramid": 0.5}))

PROFILES: Mapping[str, Profile] = MappingProxyType(
    {
        "full": FULL,
        "small": Profile(
            MappingProxyType({"pyramid": 0.25}), most=0.3, stars_per_field=10, stars_per_cell=4
        ),
    }
)


def profile_named(name: str) -> Profile:
    """Return the profile of a name; ConfigError if there is none."""
    if name not in PROFILES:
        raise ConfigError(f"expected {' or '.join(PROFILES)}", parameter="profile", value=name)
    return PROFILES[name]


def method_or_default(profile: str, method: str | None) -> str:
    """Return the method of an image: the given one, or else the profile's default."""
    methods = profile_named(profile).methods
    if method is None:
        return methods[0]
    if method not in methods and method in FULL.methods:
        raise ConfigError(
            f"there is no image for method {method!r}",
            parameter="profile",
            value=profile,
            hint=(f"choose {{method}} {' or '.join(methods)}", "leave it out"),
        )
    return method
