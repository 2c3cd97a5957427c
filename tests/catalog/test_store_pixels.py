"""HEALPix pixels: prefixes, borders against brute force, and partitions that cover every star."""

from __future__ import annotations

import numpy as np
import pytest
from cdshealpix.nested import vertices
from hypothesis import given
from hypothesis import strategies as st

from starcat.catalog.store import layout
from starcat.catalog.store.plan import partition_pixels, spill_order
from starcat.errors import ConfigError
from starcat.geometry.sphere import directions_from_radec, radec_from_directions


def points_near(pixel: layout.Pixel, width_rad: float, rng: np.random.Generator) -> np.ndarray:
    """Return pixels of order 29 of points within a distance of a pixel's edge."""
    ra, dec = vertices(np.array([pixel.number]), pixel.order, step=25)
    edge = directions_from_radec(ra.deg.ravel(), dec.deg.ravel())
    edge = np.repeat(edge, 20, axis=0)
    across = np.cross(edge, rng.normal(size=edge.shape))
    across /= np.linalg.norm(across, axis=1)[:, None]
    angle = min(width_rad, np.pi) * np.sqrt(rng.uniform(0.0, 1.0, (len(edge), 1)))
    return layout.healpix_29(*radec_from_directions(np.cos(angle) * edge + np.sin(angle) * across))


@given(st.integers(0, 12), st.integers(0, 12 * 4**12 - 1), st.floats(-7.0, 0.3), st.integers(0, 99))
def test_the_border_holds_all_within_the_distance(order, number, exponent, seed):
    pixel = layout.Pixel(order, number % (12 * 4**order))
    width = 10.0**exponent
    found = points_near(pixel, width, np.random.default_rng(seed))
    outside = found[(found < pixel.first) | (found >= pixel.end)]
    level, border = layout.border_of(pixel, width)
    assert np.isin(outside >> 2 * (layout.MAX_ORDER - level), border).all()


@given(
    st.lists(st.integers(0, 12 * 4**4 - 1), min_size=1, max_size=300, unique=True),
    st.integers(1, 40),
    st.integers(0, 2**32 - 1),
)
def test_partitions_are_the_largest_pixels_that_fit(numbers, most, seed):
    pixels = np.array(sorted(numbers))
    counts = np.random.default_rng(seed).integers(1, most + 1, len(pixels))
    found = partition_pixels(pixels, counts, 4, most, "some")
    total = 0
    for pixel in found:
        inside = (pixels >> 2 * (4 - pixel.order)) == pixel.number
        assert 0 < counts[inside].sum() <= most
        total += counts[inside].sum()
        if pixel.order:
            parent = pixels >> 2 * (5 - pixel.order) == pixel.number >> 2
            assert counts[parent].sum() > most
    assert total == counts.sum()
    assert [pixel.first for pixel in found] == sorted(pixel.first for pixel in found)


def test_too_many_stars_in_one_place_are_reported():
    with pytest.raises(ConfigError, match=r"7 stars are in one place.*max_partition_rows"):
        partition_pixels(np.array([3]), np.array([7]), 0, 6, "some")


def test_batches_of_runs_have_some_thousands_of_stars():
    assert [spill_order(n) for n in (1, 10**6, 10**7, 47 * 10**6, 10**9)] == [2, 2, 4, 5, 6]
