"""Values of options from the texts that a person writes on a command line or in a form."""

from __future__ import annotations

import re

from starcat.errors import AsWritten, ConfigError


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
        "expected a share from 0 to 50 %, such as 2% or 0.02", parameter="fov_error", value=text
    )


def size_in_px(text: str) -> tuple[int, int]:
    """Return the width and height of a text such as 1280x960."""
    sides = re.fullmatch(r"([0-9]{1,6})\s*[xX]\s*([0-9]{1,6})", text.strip())
    if sides is None:
        raise ConfigError(
            "expected WIDTHxHEIGHT in pixels, such as 1280x960", parameter="size_px", value=text
        )
    return int(sides[1]), int(sides[2])


def attitude_of_text(text: str) -> tuple[float, float, float, float]:
    """Return the quaternion of a text of four numbers."""
    try:
        x, y, z, w = (float(part) for part in text.split(","))
    except ValueError as error:
        raise ConfigError(
            "expected X,Y,Z,W, four numbers such as 0.1,-0.2,0.3,0.9",
            parameter="prior_q",
            value=text,
        ) from error
    return x, y, z, w


def field_or_range(text: str) -> tuple[float, float]:
    """Return the smallest and largest field of view; both are equal for a single field."""
    low_deg, high_deg = _ends(
        text, "fov_deg", "a field of view, such as 12, or a range, such as 5:20"
    )
    if high_deg is not None:
        return _checked_range(text, low_deg, high_deg, "fov_deg")
    if 0.0 < low_deg < 180.0:
        return low_deg, low_deg
    raise _field_error("expected a field of view between 0 and 180 deg", "fov_deg", text)


def field_range(text: str, name: str = "fov_deg", instead: str = "camera") -> tuple[float, float]:
    """Return the smallest and largest field of view of the range LOW:HIGH.

    ``name`` is the parameter, and ``instead`` the parameter that states a single field.
    """
    low_deg, high_deg = _ends(text, name, "a range LOW:HIGH, such as 5:20")
    if high_deg is None:
        raise _field_error(
            "it is a single field of view",
            name,
            text,
            f"write a range, such as {0.8 * low_deg:g}:{1.25 * low_deg:g}, or state one field with "
            f"{{{instead}}}",
        )
    return _checked_range(text, low_deg, high_deg, name)


def _ends(text: str, name: str, expected: str) -> tuple[float, float | None]:
    low, separator, high = text.partition(":")
    try:
        return float(low), float(high) if separator else None
    except ValueError:
        raise _field_error(
            f"expected {expected}", name, text, "write degrees, without a unit"
        ) from None


def _checked_range(text: str, low_deg: float, high_deg: float, name: str) -> tuple[float, float]:
    if 0.0 < low_deg <= high_deg < 180.0 and (low_deg < high_deg or name == "fov_deg"):
        return low_deg, high_deg
    is_swapped = 0.0 < high_deg < low_deg < 180.0
    raise _field_error(
        "expected two fields of view between 0 and 180 deg, the narrower one first",
        name,
        text,
        f"write {{{name}:{high_deg:g}:{low_deg:g}}}" if is_swapped else "",
    )


def _field_error(problem: str, name: str, text: str, hint: str = "") -> ConfigError:
    return ConfigError(problem, parameter=name, value=AsWritten(text), hint=hint)
