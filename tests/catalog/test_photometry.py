"""Photometry: Johnson V from Tycho, bands of 2MASS, and the light of several stars as one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from starcat.catalog.photometry import blend_weights, johnson_v
from starcat.errors import ConfigError
from starcat.pipeline.selection.merging import combined_magnitude

# Magnitudes of order 10 are rounded to 2e-15.
ROUNDING_MAG = 1e-13


@pytest.mark.parametrize(
    ("bt_mag", "vt_mag", "v_mag", "is_out_of_range"),
    [
        (9.0, 8.0, 7.910, False), (8.0, 8.0, 8.0, False), (7.8, 8.0, 8.018, False),
        (9.8, 8.0, 7.838, False), (11.0, 8.0, 7.838, True), (7.0, 8.0, 8.018, True),
    ],
    ids=["yellow", "white", "blue end", "red end", "too red", "too blue"],
)  # fmt: skip
def test_johnson_v_of_both_magnitudes(bt_mag, vt_mag, v_mag, is_out_of_range):
    found = johnson_v(np.array([bt_mag]), np.array([vt_mag]))
    assert found.mag[0] == pytest.approx(v_mag, abs=ROUNDING_MAG)
    assert not found.is_estimated[0]
    # 7.8 - 8.0 and 9.8 - 8.0 fall on either side of the ends by a rounding.
    if abs(bt_mag - vt_mag) not in np.abs(np.subtract([7.8, 9.8], 8.0)):
        assert found.is_out_of_range[0] == is_out_of_range


def test_johnson_v_where_a_magnitude_is_missing():
    none = np.nan
    found = johnson_v(np.array([none, 9.0, none]), np.array([8.0, none, none]))
    assert found.mag[:2].tolist() == [8.0, 9.0]
    assert np.isnan(found.mag[2])
    assert found.is_estimated.tolist() == [True, True, False]
    assert found.is_out_of_range.tolist() == [False, False, False]


@pytest.mark.parametrize(
    ("band", "weights"),
    [
        *((band, {band: 1.0}) for band in ("J", "H", "Ks")),
        *((band, {"J": 0.5, "H": 0.5}) for band in ("(J+H)/2", "(J + H) / 2")),
        ("(J+H+Ks)/3", {"J": 1 / 3, "H": 1 / 3, "Ks": 1 / 3}),
        ("0.6*J+0.4*H", {"J": 0.6, "H": 0.4}),
        ("0.2*J + .3*H + 0.5*Ks", {"J": 0.2, "H": 0.3, "Ks": 0.5}),
        ("1*H", {"H": 1.0}),
    ],
)
def test_weights_of_a_band(band, weights):
    assert blend_weights(band) == pytest.approx(weights)


@pytest.mark.parametrize(
    "band",
    [
        "", "V", "K", "j", "J+H", "J-H", "0.6*J+0.3*H", "0.5*J+0.5*J", "J+J", "(J+H)/3",
        "(J+H)/0", "(J+H)", "J*0.5+H*0.5", "0.5*J+", "-1*J+2*H", "J\n", "nan*J",
    ],
)  # fmt: skip
def test_an_invalid_band_is_refused(band):
    with pytest.raises(ConfigError, match="unknown band") as caught:
        blend_weights(band)
    assert caught.value.key == "band"
    assert caught.value.value == band


@pytest.mark.parametrize(
    ("mags", "expected"),
    [
        ([7.0], 7.0),
        ([5.0, 5.0], 5.0 - 2.5 * np.log10(2.0)),
        ([2.0, 4.5], 2.0 - 2.5 * np.log10(1.1)),
        ([3.0, 100.0], 3.0),
        ([6.0] * 100, 1.0),
        ([900.0, 900.0], 900.0 - 2.5 * np.log10(2.0)),
        ([-900.0, 900.0], -900.0),
    ],
)
def test_combined_magnitude(mags, expected):
    assert combined_magnitude(np.array(mags)) == pytest.approx(expected, abs=ROUNDING_MAG)


@given(st.lists(st.floats(-2.0, 30.0), min_size=1, max_size=8), st.randoms())
def test_a_group_is_as_bright_as_its_brightest_or_brighter(mags, random):
    together = combined_magnitude(np.array(mags))
    assert min(mags) - 2.5 * np.log10(len(mags)) - ROUNDING_MAG <= together <= min(mags)
    random.shuffle(mags)
    assert combined_magnitude(np.array(mags)) == pytest.approx(together, abs=ROUNDING_MAG)
