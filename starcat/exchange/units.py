"""Units as each standard writes them: those of our schemas are plain, such as ``mas/yr``."""

from __future__ import annotations

from starcat.errors import SchemaError


def unit_text(name: str, unit: str | None, standard: str) -> str | None:
    """Return the unit of a column in the spelling of a standard."""
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
