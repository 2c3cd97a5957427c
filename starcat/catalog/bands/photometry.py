"""The accuracy of the magnitudes of catalogs, by band and brightness.

The figures are from the catalogs' own descriptions, rounded. The magnitudes of stars that are too
bright for a detector are the least accurate.
"""

from __future__ import annotations

import numpy as np

from starcat.arrays import Array

NONE_BRIGHTER = float("-inf")

_GAIA = (
    (NONE_BRIGHTER, 0.15), (3.0, 0.03), (4.0, 0.018), (4.5, 0.014), (5.0, 0.009), (5.5, 0.006),
    (6.0, 0.004), (17.0, 0.02),
)  # fmt: skip
_GAIA_COLOUR = ((NONE_BRIGHTER, 0.15), (3.0, 0.05), (4.0, 0.004), (17.0, 0.02))
_TYCHO = ((NONE_BRIGHTER, 0.05), (2.0, 0.012), (9.0, 0.03), (10.0, 0.07), (11.0, 0.15))
_TWOMASS = ((NONE_BRIGHTER, 0.20), (4.5, 0.03), (14.0, 0.1))
# Of stars of J 4.5 to 5.4 and quality A the measured J differs by 0.15 mag from what V and B-V, V
# and V-I and Gaia predict, by the same for each star (docs/bands.md).
_TWOMASS_J = ((NONE_BRIGHTER, 0.20), (4.5, 0.15), (5.4, 0.03), (14.0, 0.1))

ERRORS_MAG = {
    # Riello et al. 2021, A&A 649, A3, appendix C: saturation shifts G brighter than 6 mag by about
    # 0.01, and BP and RP brighter than 4; below 3 mag nothing is certain. The steps of G from 3 to
    # 6 mag are the scatter of Hp about what G, BP and RP predict (tools/band_errors.py).
    "G": _GAIA, "BP": _GAIA_COLOUR, "RP": _GAIA_COLOUR,
    # ESA SP-1200, volume 1, section 1.3 and Hog et al. 2000, A&A 355, L27, table 1
    "Hp": ((NONE_BRIGHTER, 0.002),), "BT": _TYCHO, "VT": _TYCHO,
    "V": ((NONE_BRIGHTER, 0.01), (9.0, 0.02)), "B": ((NONE_BRIGHTER, 0.015), (9.0, 0.03)),
    "I": ((NONE_BRIGHTER, 0.02),),
    # Skrutskie et al. 2006, AJ 131, 1163, section 2.5: brighter stars saturate
    "J": _TWOMASS_J, "H": _TWOMASS, "Ks": _TWOMASS,
}  # fmt: skip

VISUAL_MAG = 0.2
"""Standard deviation of the SAO catalog's visual magnitudes, from many observers and plates."""

AMPLITUDE_SHARE = 0.354
"""Standard deviation of a sine in units of its whole range: 1 / (2 sqrt 2)."""


def band_error(band: str, mag: Array, source: str = "") -> Array:
    """Return the standard deviation of magnitudes of a catalog in a band."""
    if source == "sao":
        return np.full(len(mag), VISUAL_MAG)
    starts, errors = np.array(ERRORS_MAG[band]).T
    row = np.searchsorted(starts, np.nan_to_num(mag, nan=0.0), side="right") - 1
    return np.asarray(errors[row])


def variability_error(amplitude_mag: Array) -> Array:
    """Return the standard deviation for a whole range of variation; 0 if it is not known."""
    return np.asarray(AMPLITUDE_SHARE * np.nan_to_num(amplitude_mag, nan=0.0))
