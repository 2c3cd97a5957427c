"""The base of every section of a build spec, and the types of its keys.

Products and selection rules define their own sections with it. The build spec combines these
sections.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, field_validator

from starcat.errors import ConfigError

Mag = Annotated[float, Field(ge=-30.0, le=40.0)]
"""A magnitude in the range of real stars."""

SMALLEST_DEG = 0.001
"""An angle of at least 4 arcsec: a smaller one in a spec is a wrong unit or decimal point."""

SmallDeg = Annotated[float, Field(ge=SMALLEST_DEG, le=90.0)]
"""A radius or the width of a bin, degrees."""

FieldDeg = Annotated[float, Field(ge=0.01, lt=120.0)]
"""The full angle of a field of view, degrees."""


class Section(BaseModel):
    """A section of a spec: immutable, without unknown keys, with finite numbers only.

    A manifest records a spec. Keys and sections that were added after version 0.1.0 are recorded
    only if they differ from their defaults, so that an older spec still makes the same bytes.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    is_later: ClassVar[bool] = False
    """Whether the whole section was added after version 0.1.0: true for every new section."""

    later_keys: ClassVar[tuple[str, ...]] = ()
    """Keys of this section, without those of its base classes, that were added after version
    0.1.0."""

    not_keys: ClassVar[Mapping[str, str]] = {}
    """What to do instead, by a name that is not a key although people expect it."""

    @field_validator("*", mode="after")
    @classmethod
    def _no_name_twice(cls, value: Any) -> Any:
        """Refuse a list of names, such as catalogs, in which one is repeated."""
        if isinstance(value, tuple) and all(isinstance(item, str) for item in value):
            repeated = next((name for name, count in Counter(value).items() if count > 1), None)
            if repeated is not None:
                raise ValueError(f"{repeated!r} is named twice; name each once")
        return value

    @field_validator("*", mode="after")
    @classmethod
    def _no_negative_zero(cls, value: Any) -> Any:
        """Return 0.0 for -0.0: it passes the check for negative numbers, and must equal 0.0."""
        return value + 0.0 if isinstance(value, float) else value

    def __setattr__(self, name: str, value: Any) -> None:
        if name.startswith("_"):
            super().__setattr__(name, value)
            return
        raise ConfigError(
            f"{name} cannot be set, because a spec does not change",
            key=name,
            value=value,
            hint="make another one, with changes by dotted key: starcat.preset(name, "
            "{{'selection.faint_limit_mag': '5.5'}}), or the same with "
            "starcat.read_spec(path, ...)",
        )

    def recorded(self) -> dict[str, Any]:
        """Return the content of the section that a manifest records."""
        content = self.model_dump(mode="json")
        later = {key for each in type(self).__mro__ for key in vars(each).get("later_keys", ())}
        for name, field in type(self).model_fields.items():
            value = getattr(self, name)
            is_later = name in later
            if isinstance(value, Section):
                content[name] = value.recorded()
                is_later = is_later or value.is_later
            if is_later and value == field.default:
                del content[name]
        return content


NAME_PATTERN = r"^[a-z0-9][a-z0-9-]{0,63}$"

_NUMBER = r"(0|[1-9][0-9]{0,17})"
VERSION_PATTERN = rf"^{_NUMBER}\.{_NUMBER}\.{_NUMBER}$"


def version_numbers(version: str) -> tuple[int, int, int]:
    """Return the key by which semantic versions are sorted.

    Examples
    --------
    >>> version_numbers("1.10.0") > version_numbers("1.9.0")
    True
    """
    major, minor, patch = (int(number) for number in version.split("."))
    return major, minor, patch


PlanarDeg = Annotated[float, Field(ge=0.001, le=80.0)]
"""A radius in a tangent plane, which cannot show a point 90 deg away."""

SOURCE_NAME = r"^[0-9A-Za-z_-]{1,64}$"
"""The name of a catalog. It is never a path, because any user may send a spec to a service."""

PATTERN_WORDS = {
    NAME_PATTERN: "1 to 64 lower-case letters, digits and '-', such as gaia-12deg",
    SOURCE_NAME: "1 to 64 letters, digits, '_' and '-', such as gaia",
    r"^[a-z0-9][a-z0-9_-]{0,31}$": "1 to 32 small letters, digits, '_' and '-', such as survey",
    r"^[a-z][a-z0-9_]*$": "small letters, digits and '_', such as v_mag",
    r"^[0-9A-Za-z][0-9A-Za-z._-]{0,31}$": "1 to 32 letters, digits, '.', '_' and '-'",
    r"^$|^[a-z_][a-z0-9_.]*:[a-z_][a-z0-9_]*$": "module:function",
    r"^[a-z0-9_]+ -?[0-9]{1,19}$": "a catalog and the star's number in it, such as sao 24943",
    r"^[0-9a-f]{64}$": "64 hexadecimal digits in lower case",
    VERSION_PATTERN: "MAJOR.MINOR.PATCH, such as 1.0.1",
}
"""Description of each pattern, for messages."""

CatalogName = Annotated[str, StringConstraints(pattern=SOURCE_NAME)]
