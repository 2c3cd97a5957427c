"""From magnitudes to electrons: the signal of a star in an exposure, and the measurable stars.

The simulated star sensor of ``evaluate --ecss`` and the limits of a spec use the same formulas.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from starcat.arrays import Array
from starcat.catalog.bands.response import Response
from starcat.catalog.bands.synthetic import library, row_weights, zero_mag

PHOTONS_S_MM2 = 38_200.0
"""Photons/s and mm2 of a star of magnitude 0 if the response is not stated: Liebe's 19,100
electrons (2002, IEEE TAES 38, 587) at a quantum efficiency of 0.5."""

PLANCK_LIGHT_ERG_NM = 1.986_445_857e-9
"""Energy of a photon times its wavelength, erg nm (CODATA 2018)."""

ROW_TO_MM2 = 0.01 * 10.0
"""From erg/s/cm2/A, summed over nm, to mm2: 1 cm2 is 100 mm2, and 1 nm is 10 A."""


def photons_s_mm2(response: Response | None) -> float:
    """Return photons/s and mm2 of a star of 0 mag, weighted by a response with a peak of 1."""
    if response is None:
        return PHOTONS_S_MM2
    weights = row_weights(response)
    vega_mag = -2.5 * math.log10(float(library().vega @ weights)) - zero_mag(response, weights)
    # The weights have flux times wavelength on steps of half a nanometre.
    energy = 0.5 * float(library().vega @ weights) * ROW_TO_MM2
    return float(energy / PLANCK_LIGHT_ERG_NM * 10.0 ** (0.4 * vega_mag))


def zero_point_e_s(
    aperture_mm: float, quantum_efficiency: float, photons: float = PHOTONS_S_MM2
) -> float:
    """Return the electrons/s of a star of magnitude 0 behind an aperture of some diameter."""
    return 0.25 * math.pi * aperture_mm**2 * photons * quantum_efficiency


@dataclass(frozen=True)
class Exposure:
    """The response of a frame to light."""

    zero_point_e: float  # electrons of a star of magnitude 0 in a frame
    background_e: float  # mean electrons of a pixel without stars: dark current and sky
    read_noise_e: float  # standard deviation
    psf_sigma_px: float  # standard deviation of the Gaussian spot
    full_well_e: float  # electrons that a pixel holds

    @property
    def _noise_e2(self) -> float:
        """Variance of the background under a spot, as a fit of its shape weighs it."""
        pixels = 4.0 * math.pi * self.psf_sigma_px**2
        return pixels * (self.background_e + self.read_noise_e**2)

    def signal_to_noise(self, mag: Array) -> Array:
        """Return the signal-to-noise of stars, by a fit of their spot."""
        electrons = self.zero_point_e * 10.0 ** (-0.4 * np.asarray(mag))
        return np.asarray(electrons / np.sqrt(electrons + self._noise_e2))

    def limit_mag(self, signal_to_noise: float) -> float:
        """Return the magnitude of the star that has a signal-to-noise."""
        square = signal_to_noise**2
        electrons = 0.5 * (square + math.sqrt(square**2 + 4.0 * square * self._noise_e2))
        return 2.5 * math.log10(self.zero_point_e / electrons)

    @property
    def saturation_mag(self) -> float:
        """The magnitude of a star that fills the well of a pixel if it is in the middle of it."""
        share = math.erf(0.5 / (self.psf_sigma_px * math.sqrt(2.0))) ** 2
        free_e = max(self.full_well_e - self.background_e, 1e-9)
        return 2.5 * math.log10(self.zero_point_e * share / free_e)
