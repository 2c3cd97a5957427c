"""Values of options from the texts that a person writes on a command line or in a form.

Messages name the parameters as Python does; an interface replaces these names by its own.
"""

from __future__ import annotations

import re

from starcat.errors import ConfigError


def share_of_percent(text: str) -> float:
    """Return the number that a share stands for.

    Examples
    --------
    >>> share_of_percent("2%"), share_of_percent("0.1")
    (0.02, 0.1)
    """
    number, percent, rest = text.strip().partition("%")
    try:
        if not rest:
            return float(number) / (100.0 if percent else 1.0)
    except ValueError:
        pass
    raise ConfigError(
        f"fov_error is {text!r}; expected a share from 0 to 50 %, such as 2% or 0.02",
        key="fov_error",
        value=text,
        fields=("fov_error",),
    )


def size_in_px(text: str) -> tuple[int, int]:
    """Return the width and height of a text such as 1280x960."""
    sides = re.fullmatch(r"([0-9]{1,6})\s*[xX]\s*([0-9]{1,6})", text.strip())
    if sides is None:
        raise ConfigError(
            f"size_px {text!r} is not WIDTHxHEIGHT in pixels, such as 1280x960",
            key="size_px",
            value=text,
            fields=("size_px",),
        )
    return int(sides[1]), int(sides[2])


def attitude_of_text(text: str) -> tuple[float, float, float, float]:
    """Return the quaternion of a text of four numbers."""
    try:
        x, y, z, w = (float(part) for part in text.split(","))
    except ValueError as error:
        raise ConfigError(
            f"prior_q {text!r} is not X,Y,Z,W, four numbers such as 0.1,-0.2,0.3,0.9",
            key="prior_q",
            value=text,
            fields=("prior_q",),
        ) from error
    return x, y, z, w


def field_or_range(text: str) -> tuple[float, float]:
    """Return the smallest and largest field of view; both are equal for a single field."""
    low_deg, high_deg = _ends(
        text, "fov_deg", "neither a field of view, such as 12, nor a range, such as 5:20"
    )
    if high_deg is not None:
        return _checked_range(text, low_deg, high_deg, "fov_deg")
    if 0.0 < low_deg < 180.0:
        return low_deg, low_deg
    raise _field_error(f"fov_deg is {text}; expected a field of view between 0 and 180 deg")


def field_range(text: str, name: str = "fov_deg", instead: str = "camera") -> tuple[float, float]:
    """Return the smallest and largest field of view of the range LOW:HIGH.

    ``name`` is the parameter, and ``instead`` the parameter that states a single field.
    """
    low_deg, high_deg = _ends(text, name, "not a range LOW:HIGH, such as 5:20")
    if high_deg is None:
        raise _field_error(
            f"{name} {text!r} is a single field of view; write a range, such as {name} "
            f"{0.8 * low_deg:g}:{1.25 * low_deg:g}, or state one field with {instead}",
            name,
            instead,
        )
    return _checked_range(text, low_deg, high_deg, name)


def _ends(text: str, name: str, problem: str) -> tuple[float, float | None]:
    low, separator, high = text.partition(":")
    try:
        return float(low), float(high) if separator else None
    except ValueError:
        message = f"{name} {text!r} is {problem}; write degrees, without a unit"
        raise _field_error(message, name) from None


def _checked_range(text: str, low_deg: float, high_deg: float, name: str) -> tuple[float, float]:
    if 0.0 < low_deg <= high_deg < 180.0 and (low_deg < high_deg or name == "fov_deg"):
        return low_deg, high_deg
    is_swapped = 0.0 < high_deg < low_deg < 180.0
    order = f"; write {name} {high_deg:g}:{low_deg:g}" if is_swapped else ""
    raise _field_error(
        f"{name} is {text}; expected two fields of view between 0 and 180 deg, the narrower one "
        f"first{order}",
        name,
    )


def _field_error(message: str, *fields: str) -> ConfigError:
    names = fields or ("fov_deg",)
    return ConfigError(message, key=names[0], fields=names)
