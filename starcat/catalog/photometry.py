"""Magnitudes in the band that a build requires, from the archive's magnitudes."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array
from starcat.errors import ConfigError

JOHNSON_COLOUR_RANGE_MAG = (-0.2, 1.8)
"""Range of BT - VT in which the Johnson formula is valid (ESA SP-1200, vol. 1, p. 57)."""

JOHNSON_SLOPE = 0.090
"""V is VT minus this fraction of BT - VT."""

_TERM = re.compile(r"(?:(\d+(?:\.\d+)?|\.\d+)\*)?(J|H|Ks)")


@dataclass(frozen=True)
class JohnsonV:
    """Johnson V of Tycho stars."""

    mag: Array  # shape (N,): V; NaN if neither magnitude is known
    # shape (N,): VT or BT is missing, so no colour correction was possible
    is_estimated: NDArray[np.bool_]
    # shape (N,): the colour is outside the formula's range; the end of the range was used
    is_out_of_range: NDArray[np.bool_]


def johnson_v(bt_mag: Array, vt_mag: Array) -> JohnsonV:
    """Return Johnson V from Tycho BT and VT.

    References
    ----------
    Hog et al. 2000, ReadMe of I/259, note 7.
    """
    colour = bt_mag - vt_mag
    low, high = JOHNSON_COLOUR_RANGE_MAG
    mag = vt_mag - JOHNSON_SLOPE * np.clip(colour, low, high)
    missing = np.isnan(mag)
    mag = np.where(missing, np.where(np.isnan(vt_mag), bt_mag, vt_mag), mag)
    out_of_range = (colour < low) | (colour > high)
    return JohnsonV(mag, missing & ~np.isnan(mag), out_of_range)


def blend_weights(band: str) -> dict[str, float]:
    """Return the weights of J, H and Ks in a band of 2MASS."""
    compact = band.replace(" ", "")
    mean = re.fullmatch(r"\((.+)\)/([1-9]\d*)", compact)
    terms = [_TERM.fullmatch(term) for term in (mean[1] if mean else compact).split("+")]
    divisor = float(mean[2]) if mean else 1.0
    weights: dict[str, float] = {}
    for term in terms:
        if term is None or term[2] in weights:
            raise ConfigError(_blend_message(band), key="band", value=band)
        weights[term[2]] = float(term[1] or 1.0) / divisor
    if abs(sum(weights.values()) - 1.0) > 1e-9:
        raise ConfigError(_blend_message(band), key="band", value=band)
    return weights


def _blend_message(band: str) -> str:
    return (
        f"unknown band {band!r} of 2mass; use J, H, Ks, (J+H)/2 or a weighted sum whose weights "
        "add up to 1, such as 0.6*J+0.4*H"
    )
