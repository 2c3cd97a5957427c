"""Arguments of public functions, as plain numbers, columns and paths.

Callers give numbers as lists, numpy arrays, quantities of astropy, masked arrays or columns of
tables, and databases as paths or as objects that other functions of starcat return. Every public
function converts them to float64 arrays and paths here, so that all accept and refuse the same.
Nothing here imports astropy, pandas or pyarrow: their objects are recognised by their attributes.
"""

from __future__ import annotations

import operator
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from starcat.arrays import Array
from starcat.errors import ConfigError

FLOAT64 = np.dtype(np.float64)

# Unit by the suffix of a parameter name. Longer suffixes come first: "_km_s" ends with "_s" too.
UNITS = {
    "_km_s": "km / s", "_km": "km", "_arcsec": "arcsec", "_mas": "mas", "_deg": "deg",
    "_rad": "rad", "_px": "pix", "mag": "mag", "_s": "s",
}  # fmt: skip


class HasFolder(Protocol):
    """An object with a folder, as `starcat.open`, `starcat.build` and `starcat.pull` return it."""

    @property
    def folder(self) -> Path:
        """Return the folder of the database."""


def unit_of_argument(name: str) -> str:
    """Return the unit that the name of a parameter states, as astropy writes it.

    Examples
    --------
    >>> unit_of_argument("velocity_km_s"), unit_of_argument("prior")
    ('km / s', '')
    """
    return next((unit for end, unit in UNITS.items() if name.endswith(end)), "")


def numbers_of(name: str, values: Any, shape: str | tuple[int, ...]) -> Array:
    """Return an argument as an array of real numbers.

    Parameters
    ----------
    name : str
        Name of the parameter. Its suffix states the unit, such as ``_km``.
    values : array_like
        Real numbers. A quantity with a unit is converted to the unit of the parameter. Masked
        entries, and None in a list, become NaN. Strings, bools and complex numbers are refused.
    shape : str or tuple of int
        Shape for the error message; it is not checked here.

    Returns
    -------
    ndarray of float64

    Raises
    ------
    ConfigError
        If the values are not real numbers, or their unit cannot be converted.
    """
    if type(values) is np.ndarray and values.dtype is FLOAT64:  # fast path: nearly all calls
        return values
    mask = getattr(values, "mask", None)  # a method if it is a pandas column
    plain = without_unit(name, values)
    try:
        raw = np.asarray(plain)
        if raw.dtype.kind == "O":
            raw = np.array([_number(value) for value in raw.flat]).reshape(raw.shape)
        if raw.dtype.kind not in "fiu":
            raise TypeError(f"their type is {_TYPES.get(raw.dtype.kind, raw.dtype)}")
        numbers = np.asarray(raw, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ConfigError(
            f"not an array of real numbers ({error}); expected one of shape {shape}", parameter=name
        ) from error
    if isinstance(mask, np.ndarray | np.bool_) and np.any(mask):
        numbers = np.where(mask, np.nan, numbers)
    return numbers


def rows_of(name: str, values: Any, width: int, count: str = "N") -> Array:
    """Return an argument as rows of ``width`` real numbers, converted as by `numbers_of`.

    Parameters
    ----------
    name : str
        Name of the parameter. Its suffix states the unit.
    values : array_like
        Real numbers of shape (N, width). An empty list is no rows.
    width : int
        Numbers in a row.
    count : str, default "N"
        Name of the number of rows in the error message.

    Returns
    -------
    ndarray of float64, shape (N, width)

    Raises
    ------
    ConfigError
        If the values are not real numbers, have another shape, or their unit cannot be converted.
    """
    numbers: Array
    if type(values) is np.ndarray and values.dtype is FLOAT64 and values.shape[1:] == (width,):
        numbers = values  # fast path: nearly all calls
        return numbers
    expected = f"({count}, {width})"
    numbers = numbers_of(name, values, expected)
    if numbers.shape == (0,):
        return numbers.reshape(0, width)
    if numbers.shape[1:] != (width,):
        raise ConfigError(
            f"its shape is {numbers.shape}; expected {expected}",
            parameter=name,
            hint="a single row is a list of one row" if numbers.shape == (width,) else (),
        )
    return numbers


_TYPES = {"U": "text", "S": "text", "b": "bool", "c": "complex"}


def _number(value: Any) -> float:
    if value is None:
        return np.nan
    if isinstance(value, bool | np.bool_ | str | bytes):
        raise TypeError(f"{value!r} is {'text' if isinstance(value, str | bytes) else 'a bool'}")
    return float(value)


def without_unit(name: str, values: Any) -> Any:
    """Return a number or numbers without their unit, converted to the unit of the parameter.

    An array without dimensions becomes its number.

    Raises
    ------
    ConfigError
        If the unit cannot be converted.

    Examples
    --------
    >>> import astropy.units as u
    >>> float(without_unit("fov_x_deg", 30.0 * u.arcmin)), without_unit("fov_x_deg", 0.5)
    (0.5, 0.5)
    """
    unit = getattr(values, "unit", None)
    if unit is None:
        unit = getattr(values, "units", None)  # the name in other libraries of units
    if unit is None:
        return values[()] if type(values) is np.ndarray and values.ndim == 0 else values
    expected = unit_of_argument(name)
    try:
        quantity = getattr(values, "quantity", values)  # a column of an astropy table has it
        plain = quantity.to_value(expected)
    except Exception as error:  # the library of units may raise anything
        raise ConfigError(
            f"its unit is {str(unit) or 'dimensionless'!r}; expected "
            f"{expected or 'numbers without a unit'}",
            parameter=name,
        ) from error
    return getattr(plain, "unmasked", plain)


def without_unit_of_count(name: str, value: Any) -> Any:
    """Return a whole number without its unit; quantities have floating-point numbers only."""
    plain = without_unit(name, value)
    is_whole = plain is not value and isinstance(plain, float) and plain.is_integer()
    return int(plain) if is_whole else plain


def columns_of(values: Any) -> dict[str, Any] | None:
    """Return the columns of a table by name, or None if the values are not a table.

    A table is a mapping of columns, a structured array, or a table of astropy, pandas, polars or
    Arrow.
    """
    if isinstance(values, list | tuple):
        return None
    names: Any = values if isinstance(values, Mapping) else None
    if names is None:
        names = getattr(getattr(values, "dtype", None), "names", None)
    for attribute in ("colnames", "column_names", "columns"):
        if names is None:
            names = getattr(values, attribute, None)
    return None if names is None else {str(name): values[name] for name in names}


def whole_number(name: str, value: Any, least: int) -> int:
    """Return an argument that has to be a whole number, at least ``least``."""
    try:
        number = operator.index(without_unit_of_count(name, value))
    except TypeError:
        number = least - 1
    if isinstance(value, bool) or number < least:
        raise ConfigError(f"expected a whole number, at least {least}", parameter=name, value=value)
    return number


def wrong_type(name: str, value: object, expected: str) -> TypeError:
    """Return the error for an argument of the wrong type."""
    return TypeError(f"{name} is of type {type(value).__name__}; expected {expected}")


def check_type(name: str, value: object, kind: type | tuple[type, ...], expected: str) -> None:
    """Raise TypeError if an argument is not of the expected type."""
    if not isinstance(value, kind):
        raise wrong_type(name, value, expected)


def path_of(name: str, value: Any, expected: str = "a path (text or os.PathLike)") -> Path:
    """Return an argument that has to be a path.

    Raises
    ------
    TypeError
        If it is not a path.
    """
    try:
        return Path(os.fsdecode(os.fspath(value)))
    except TypeError:
        raise wrong_type(name, value, expected) from None


def text_of_path(name: str, value: Any) -> str:
    """Return a path or an address as text; a path would turn the // of an address into /."""
    return value if isinstance(value, str) else str(path_of(name, value))


def paths_of(name: str, value: Any) -> list[Path]:
    """Return an argument that has to be a path, or paths."""
    if isinstance(value, str | os.PathLike) or not isinstance(value, Iterable):
        return [path_of(name, value, "a path, or a sequence of paths")]
    return [path_of(name, path, "paths") for path in value]


def database_path(name: str, value: Any) -> Path:
    """Return the folder of a database.

    A caller passes the folder itself, or an object that has a ``folder``: the result of
    `starcat.open`, `starcat.build` or `starcat.pull`, or the ``database`` of a matcher.
    """
    folder = getattr(value, "folder", None)
    given = value if folder is None else folder
    return path_of(name, given, "the folder of a database, or what starcat.open returns")
