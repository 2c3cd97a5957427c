"""The options of an identification, each declared once, for all interfaces.

A field of `IdentifyOptions` has the type, default, range, description and spelling of an option.
Python's checks, the options of the command line, the REST interface with its JSON schema, the
fields of the service's form and the reference are made from it. Who adds an option adds one field
here, and the code that reads it.

Only the standard library is imported, so that ``starcat --help`` stays fast. A description names
another option as ``{tolerance_px}``; each interface fills in its own name.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, fields
from functools import cache
from numbers import Real
from typing import Any, ClassVar, Literal, get_args, get_type_hints

from starcat.errors import AsWritten, ConfigError, NameOf, filled, python_name
from starcat.matcher.option_texts import (
    attitude_of_text,
    field_or_range,
    share_of_percent,
    size_in_px,
)

Panel = Literal["Search", "Camera", "Pictures", "Time and place", "Output"]

UNITS = {"px": "px", "deg": "deg", "mag": "mag", "s": "s"}
"""Unit in forms by the end of an option's name."""


@dataclass(frozen=True)
class Option:
    """One option, as its field declares it."""

    name: str
    kind: type  # bool, int, float, str or tuple
    default: Any
    template: str  # what it is; "{name}" stands for another option
    low: float = -math.inf  # smallest and largest number that is accepted
    high: float = math.inf
    panel: Panel = "Search"  # group in the help
    spellings: tuple[str, ...] = ()  # on the command line, if they are not the name
    metavar: str | None = None  # form of the value on the command line
    parse: Callable[[str], Any] | None = None  # value of a text of the command line or a form

    @property
    def description(self) -> str:
        """What the option is, with the names of Python."""
        return self.described(python_name)

    def described(self, name_of: NameOf) -> str:
        """Return what the option is, with the names of an interface.

        Examples
        --------
        >>> OPTIONS["size_px"].described(lambda name, *_: f"--{name}")
        'Size of a frame of centroids, such as 1280x960; with --fov_deg.'
        """
        return filled(self.template, name_of) or self.template

    @property
    def range_words(self) -> str:
        """The range as the end of the sentence "expected ...".

        Examples
        --------
        >>> OPTIONS["tolerance_px"].range_words, OPTIONS["max_steps"].range_words
        ('0.001 to 200', 'a number, at least 1')
        """
        if self.high == math.inf:
            return f"a number, at least {self.low:g}"
        return f"{self.low:g} to {self.high:g}"

    @property
    def is_number(self) -> bool:
        """Whether the value is a number in a range."""
        return self.low > -math.inf

    @property
    def label(self) -> str:
        """Name of the option in a form.

        Examples
        --------
        >>> OPTIONS["noise_mag"].label, OPTIONS["max_false_match_probability"].label
        ('Noise', 'Max false match probability')
        """
        words = self.name.split("_")
        if words[-1] in UNITS:
            words.pop()
        return " ".join(words).capitalize()

    @property
    def unit(self) -> str | None:
        """Unit in a form: the end of the name."""
        return UNITS.get(self.name.rpartition("_")[2])

    @property
    def choices(self) -> tuple[tuple[str, str], ...]:
        """The values in a form and their texts, if there are few."""
        return (("", "no"), ("yes", "yes")) if self.kind is bool else ()

    def value_of(self, text: str) -> Any:
        """Return the value of a text of a form."""
        if self.parse is not None:
            return self.parse(text)
        if self.kind is bool:
            return text.lower() not in ("", "0", "off", "false", "no")
        if not self.is_number:
            return text
        try:
            return int(text) if self.kind is int else float(text)
        except ValueError:
            return text  # the check of the option says what is expected


def option(
    default: Any,
    description: str,
    low: float = -math.inf,
    high: float = math.inf,
    *,
    most_characters: int | None = None,
    **spelling: Any,
) -> Any:
    """Declare an option: the field of a dataclass.

    The ends of the range are included. ``spelling`` has the fields of `Option` about the command
    line. The keys of the metadata are the ones that pydantic reads from a dataclass.
    """
    metadata: dict[str, Any] = {"description": filled(description)}
    if low > -math.inf:
        metadata["ge"] = low
    if high < math.inf:
        metadata["le"] = high
    if most_characters is not None:
        metadata["max_length"] = most_characters
    metadata["spelling"] = {"template": description, "low": low, "high": high, **spelling}
    return field(default=default, metadata=metadata)


@cache
def options_of(declaration: type) -> Mapping[str, Option]:
    """Return the options that a dataclass declares, by name."""
    types, options = get_type_hints(declaration), {}
    for each in fields(declaration):
        if "spelling" in each.metadata:
            kind, *_ = get_args(types[each.name]) or (types[each.name],)  # the type without None
            options[each.name] = Option(each.name, kind, each.default, **each.metadata["spelling"])
    return options


def documented(declaration: type) -> type:
    """Return a dataclass whose docstring lists its options, from their declarations."""
    lines = ["Attributes", "----------"]
    for each in options_of(declaration).values():
        default = "optional" if each.default is None else f"default {each.default!r}"
        kind = str(getattr(each.kind, "__name__", each.kind))
        lines.append(f"{each.name} : {kind}, {default}")
        lines.append(f"    {each.description}")
        if each.is_number:
            lines[-1] += f" Range: {each.range_words}."
    declaration.__doc__ = "\n    ".join([f"{(declaration.__doc__ or '').rstrip()}\n", *lines])
    return declaration


@dataclass(frozen=True, kw_only=True)
class SearchOptions:
    """The options that a matcher is opened with; None is the default that the text states."""

    method: str | None = option(
        None, "See 'starcat methods'; default: the best available method.", most_characters=40
    )
    tolerance_px: float | None = option(
        None, "Largest error of a centroid; default: 2.", 0.001, 200
    )
    noise_px: float | None = option(
        None, "Noise of a centroid, each axis; instead of {tolerance_px}.", 0.001, 50
    )
    noise_mag: float | None = option(
        None, "Noise of magnitudes in the database's band.", 0.0001, 10
    )
    max_false_match_probability: float = option(
        1e-9, "Answers less certain than this are withheld.", 0, 1
    )
    min_share: float | None = option(
        None,
        "Smallest share of the frame that an answer explains; default: none is required.",
        0,
        1,
    )
    camera_error: float | None = option(
        None,
        "Largest error of the camera at the corners, as a share of the half diagonal; default: "
        "wide ranges of the frame's shape.",
        1e-6,
        0.1,
    )
    max_steps: int | None = option(
        None,
        "Candidates that the numpy matcher may compare, 2 to 20 microseconds each; default: "
        "100,000. Not for an onboard image, which counts other steps.",
        1,
    )
    time_limit_s: float | None = option(
        None, "Time limit per frame, seconds.", 1e-6, spellings=("time-limit-s", "time-limit")
    )


@dataclass(frozen=True, kw_only=True)
class IdentifyOptions(SearchOptions):
    """How frames are identified; each as the option of 'starcat identify' with that name."""

    __pydantic_config__: ClassVar[dict[str, str]] = {"extra": "forbid"}

    prior_q: tuple[float, float, float, float] | None = option(
        None,
        "Expected attitude, q_body_from_icrs: only stars near it are compared.",
        metavar="X,Y,Z,W",
        parse=attitude_of_text,
    )
    prior_error_deg: float | None = option(None, "Largest error of {prior_q}, degrees.", 1e-9, 20)
    camera: str | None = option(
        None,
        "Text of a camera file; the database's by default. Without a size it is of a "
        "camera whose frames have the size of the image, or of the database's camera.",
        most_characters=20_000,
        panel="Camera",
    )
    fov_error: float | None = option(
        None,
        "Largest error of the field of view; default: 5 %.",
        0,
        0.5,
        panel="Camera",
        metavar="2%",
        parse=share_of_percent,
    )
    fov_deg: tuple[float, float] | None = option(
        None,
        "Field across the width instead of the camera's, degrees; or its range.",
        panel="Camera",
        spellings=("fov",),
        metavar="DEG|LOW:HIGH",
        parse=field_or_range,
    )
    size_px: tuple[int, int] | None = option(
        None,
        "Size of a frame of centroids, such as 1280x960; with {fov_deg}.",
        panel="Camera",
        spellings=("size",),
        metavar="WxH",
        parse=size_in_px,
    )
    flip: bool | None = option(None, "First row at the bottom; y upwards.", panel="Camera")
    psf_sigma_px: float | None = option(
        None, "Width (sigma) of a star in an image; default: measured.", 0.3, 20, panel="Pictures"
    )
    threshold: float = option(
        5.0, "Smallest signal-to-noise ratio of a spot.", 1, 1000, panel="Pictures"
    )
    # Measured: spots beyond the brightest 200 identify no further picture, and cost time.
    most_spots: int = option(
        200, "Use this many of the brightest spots.", 4, 10_000, panel="Pictures"
    )
    plane: int | None = option(
        None, "Plane of a FITS cube, from 0; default: colours combined.", 0, panel="Pictures"
    )
    bayer: bool = option(False, "The image is a raw colour mosaic, in any order.", panel="Pictures")
    time: str | None = option(
        None,
        "Time, such as 2026-11-22T10:00:00 (UTC): aberration, planets.",
        most_characters=40,
        panel="Time and place",
        metavar="UTC",
    )

    def __post_init__(self) -> None:
        check_options(self, IdentifyOptions)
        if isinstance(self.fov_deg, Real):
            object.__setattr__(self, "fov_deg", (self.fov_deg, self.fov_deg))
        for name in ("prior_q", "fov_deg", "size_px"):
            if isinstance(getattr(self, name), list):
                object.__setattr__(self, name, tuple(getattr(self, name)))
        check_prior_has_error("prior_q", self.prior_q, self.prior_error_deg)
        if self.is_range and self.fov_error is not None:
            raise ConfigError(
                "a range of fields has its own errors",
                hint="give either {fov_deg}, a range of fields, or {fov_error}, not both",
            )
        if self.size_px is not None and self.fov_deg is None:
            raise ConfigError(
                "the size of a frame needs its field of view",
                parameter="size_px",
                hint="give {fov_deg} too; for other frames state the size with {camera}",
            )

    @property
    def is_one_field(self) -> bool:
        """Whether one field of view is stated in place of the camera's, and not a range."""
        return self.fov_deg is not None and self.fov_deg[0] == self.fov_deg[1]

    @property
    def is_range(self) -> bool:
        """Whether a range of fields of view is stated."""
        return self.fov_deg is not None and not self.is_one_field

    def search(self) -> SearchOptions:
        """Return the options that a matcher is opened with."""
        return SearchOptions(
            **{each.name: getattr(self, each.name) for each in fields(SearchOptions)}
        )

    def stated(self) -> dict[str, Any]:
        """Return the options that differ from their defaults, by name."""
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        return {name: value for name, value in values.items() if value != OPTIONS[name].default}


@dataclass(frozen=True, kw_only=True)
class SimulationOptions:
    """The errors of simulated frames."""

    noise_px: float = option(0.5, "Noise of a centroid, each axis.", 0, 50)
    noise_mag: float = option(0.2, "Noise of a magnitude.", 0, 10)
    drop_probability: float = option(0.0, "Probability that a star is missing.", 0, 1)


documented(IdentifyOptions)

OPTIONS = options_of(IdentifyOptions)
"""Options of an identification, by the name of the parameter in Python and REST."""

SIMULATED = options_of(SimulationOptions)
"""Options of simulated frames, by the name of the parameter."""


def check_options(declared: Any, declaration: type) -> None:
    """Check the numbers of an instance of a declaration, and convert quantities."""
    for name, each in options_of(declaration).items():
        value = getattr(declared, name)
        if each.is_number and not (value is None and each.default is None):
            checked = checked_option(name, value, options_of(declaration))
            object.__setattr__(declared, name, checked)


def check_prior_has_error(name: str, prior: object, error_deg: object) -> None:
    """Check that a prior and its error are given together; ``name`` is the prior's parameter."""
    if (prior is None) != (error_deg is None):
        raise ConfigError(
            "a prior and its error go together",
            parameter=name if prior is None else "prior_error_deg",
            value=AsWritten("missing"),
            hint=f"give both {{{name}}} and {{prior_error_deg}}, or neither",
        )


def checked_option(name: str, value: Any, options: Mapping[str, Option] = OPTIONS) -> Any:
    """Return the value of an option that has to be a number in the option's range.

    A quantity is converted to the unit of the parameter.
    """
    declared = options[name]
    low, high = declared.low, declared.high
    if type(value) is float and low <= value <= high and declared.kind is float:
        return value  # nearly all calls end here
    if not isinstance(value, Real):
        from starcat.arguments import without_unit

        value = without_unit(name, value)
    if isinstance(value, Real) and not isinstance(value, bool):
        with suppress(OverflowError):  # a whole number may be too large for a float
            number = float(value)
            is_whole = declared.kind is not int or number in (math.inf, number // 1)
            if low <= number <= high and is_whole:
                return value
    raise ConfigError(f"expected {declared.range_words}", parameter=name, value=value)
