"""Which bands the catalogs have, and the relations that they give for a sensor's band."""

from __future__ import annotations

from collections.abc import Sequence

from starcat.catalog.bands.relation import Relation, relation
from starcat.catalog.bands.response import Response, shipped_names

BANDS_AND_COLOURS = {
    "gaia": (("G", "BP", "RP"), ("BP-RP",)),
    "hipparcos": (("V", "Hp", "B", "I"), ("B-V", "V-I")),
    "hipparcos2": (("Hp",), ("B-V", "V-I")),
    "tycho1": (("V", "B"), ("B-V",)),
    "tycho2": (("V", "BT", "VT"), ("BT-VT",)),
    "2mass": (("Ks", "H", "J"), ("J-Ks",)),
}
"""Bands, the usual first, and colours of the catalogs; the SAO catalog has spectral types."""

AS_EXACT = 1.25
"""Relations whose errors are within this factor of the smallest error count as equally exact; the
first band's is taken."""


def colour_of(text: str) -> tuple[str, str] | None:
    """Return the two bands of a colour such as BP-RP; None if one of them is unknown.

    Examples
    --------
    >>> colour_of("BP-RP"), colour_of("u-g")
    (('BP', 'RP'), None)
    """
    first, _, second = text.partition("-")
    return (first, second) if {first, second} <= set(shipped_names()) else None


def relations_of(bands: Sequence[str], colours: Sequence[str], target: Response) -> list[Relation]:
    """Return the relations from bands and colours to a sensor's band, the most exact first.

    The errors computed from the spectra determine the order: few bands have measured errors.
    """
    pairs = [pair for pair in map(colour_of, colours) if pair]
    candidates = [relation(base, pair, target) for base in bands for pair in pairs]
    least = min((candidate.typical_computed_mag for candidate in candidates), default=0.0)
    return sorted(
        candidates, key=lambda candidate: max(candidate.typical_computed_mag, AS_EXACT * least)
    )


def best_relation(source: str, target: Response) -> Relation:
    """Return the most exact relation that a catalog gives for a sensor's band."""
    bands, colours = BANDS_AND_COLOURS[source]
    return relations_of(bands, colours, target)[0]
