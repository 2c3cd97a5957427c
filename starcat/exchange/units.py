"""Units as each standard writes them: those of our schemas are plain, such as ``mas/yr``."""

from __future__ import annotations

from starcat.errors import SchemaError


def unit_text(name: str, unit: str | None, standard: str) -> str | None:
    """Return the unit of a column in the spelling of a standard.

    Parameters
    ----------
    name : str
        Name of the column, for the message.
    unit : str, optional
        Its unit as our schemas write it.
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
    if not unit:
        return None
    from astropy import units

    try:
        return str(units.Unit(unit).to_string(standard))
    except (ValueError, TypeError) as error:
        raise SchemaError(
            f"column {name!r}: unit {unit!r} is not one that {standard} knows; "
            "mend the unit, or export to CSV or JSON",
            field=name,
            found=unit,
        ) from error
