"""Stars in cells: a direction has a star within reach, or it has not."""

from __future__ import annotations

import numpy as np
import pytest

from starcat.geometry.sphere import separation
from starcat.matcher.star_cells import star_cells


@pytest.mark.parametrize("reach_rad", [1e-4, 0.004, 0.03])
def test_has_star_is_brute_force(random_directions, reach_rad):
    stars, asked = random_directions(400, 1), random_directions(2000, 2)
    # Half of those asked for lie near a star, on either side of the reach.
    asked[:1000] = stars[np.arange(1000) % 400] + 1.2 * reach_rad * asked[:1000]
    asked[:1000] /= np.linalg.norm(asked[:1000], axis=1)[:, None]
    chord = 2.0 * np.sin(0.5 * separation(asked[:, None, :], stars[None, :, :]).min(axis=1))
    found = star_cells(stars, reach_rad).has_star(asked, reach_rad)
    clear = np.abs(chord - reach_rad) > 1e-12
    assert found[clear].tolist() == (chord <= reach_rad)[clear].tolist()
    assert 100 < found.sum() < 2000


def test_axes_and_corners_of_cells_are_no_gaps():
    stars = np.concatenate([np.eye(3), -np.eye(3)])
    cells = star_cells(stars, 0.005)
    assert cells.has_star(stars, 0.005).all()
    turned = stars + 0.0049 * np.roll(stars, 1, axis=1)
    assert cells.has_star(turned / np.linalg.norm(turned, axis=1)[:, None], 0.005).all()


def test_one_star_and_no_question():
    cells = star_cells(np.array([[0.0, 0.0, 1.0]]), 0.001)
    assert cells.has_star(np.empty((0, 3)), 0.001).tolist() == []
    assert cells.has_star(np.array([[0.0, 1.0, 0.0]]), 0.001).tolist() == [False]
    with pytest.raises(ValueError, match="these cells allow"):
        cells.has_star(np.array([[0.0, 1.0, 0.0]]), 2.0 * cells.margin)
