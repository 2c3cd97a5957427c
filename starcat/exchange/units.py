"""Units as each standard writes them: those of our schemas are plain, such as ``mas/yr``."""

from __future__ import annotations

from starcat.errors import SchemaError
from starcat.exchange.numpy_columns import NumpyColumn


def unit_text(column: NumpyColumn, standard: str) -> str | None:
    """Return the unit of a column in the spelling of a standard.

    Parameters
    ----------
    column : NumpyColumn
        With its unit among the facts.
    standard : {"fits", "vounit", "generic"}
        A unit format of `astropy.units`.

    Returns
    -------
    str or None
        Such as ``mas yr-1`` (FITS) or ``mas.yr**-1`` (VOUnit); None without a unit.

    Raises
    ------
    SchemaError
        If the standard does not know the unit.
    """
    from astropy import units

    text = column.facts.get("unit")
    if not text:
        return None
    try:
        return str(units.Unit(text).to_string(standard))
    except (ValueError, TypeError) as error:
        raise SchemaError(
            f"column {column.name!r}: unit {text!r} is not one that {standard} knows; "
            "mend the unit, or export to CSV or JSON",
            field=column.name,
            found=text,
        ) from error
