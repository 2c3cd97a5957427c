"""Real frames of a star sensor whose lens nobody calibrated, taken while it was slewing.

The lens distorts, and a rolling shutter stretches the rows: the shape of the frame is fitted with
the attitude. An answer is right within 0.2 deg of the attitude that a fit of the whole shape found.
"""

from __future__ import annotations

import csv

import numpy as np
import pytest
from frames import both_engines

import starcat
from starcat.geometry.sphere import directions_from_radec, separation
from starcat.matcher.matcher import Matcher
from starcat.pipeline.build import build
from starcat.pipeline.specs.reading import read_spec


@pytest.fixture(scope="module")
def database(nights, tmp_path_factory):
    spec = read_spec(nights / "startracker" / "startracker.toml", {"self_test.frames": "5"})
    return build(spec, tmp_path_factory.mktemp("sensor")).folder


@pytest.fixture(scope="module")
def frames(nights):
    """The centroids of each frame, and the boresight that is right for it."""
    folder, found = nights / "startracker", []
    with (folder / "answers.csv").open() as file:
        for row in csv.DictReader(file):
            [frame] = starcat.read_frames(
                folder / "centroids" / f"frame_{int(row['frame']):02d}.csv"
            )
            radec = np.array([float(row["ra_deg"])]), np.array([float(row["dec_deg"])])
            found.append((frame.centroids_px, directions_from_radec(*radec)[0]))
    assert len(found) == 38
    return found


@both_engines
@pytest.mark.parametrize("fov_error", [0.0, 0.03])
def test_every_frame_is_right_and_its_spots_have_stars(database, frames, engine, fov_error):
    matcher, fractions, shapes = Matcher.open(database, engine=engine), [], []
    for centroids_px, boresight in frames:
        found = matcher.identify(centroids_px, fov_error=fov_error)
        assert found.ok
        off_rad = separation(found.matrix[2][None], boresight[None])[0]
        assert np.degrees(off_rad) < 0.2
        fractions.append(found.n_matched / len(centroids_px))
        if found.shape is not None:
            shapes.append(found.shape.terms)
    assert np.mean(fractions) >= 0.8
    # Lens: the same in all frames. Rolling shutter: up to 1.8 % either way.
    assert len(shapes) >= 25
    radial, stretch = np.array(shapes)[:, 1], np.array(shapes)[:, 2]
    assert np.std(radial) < 0.01
    assert 0.01 < np.abs(stretch).max() < 0.03
