"""Frames that show the same stars twice are ambiguous."""

from __future__ import annotations

import numpy as np
from frames import both_engines, error_arcsec, frames_of

from starcat.matcher.matcher import Matcher
from starcat.pipeline.simulation.simulate import Noise

SHIFT_PX = np.array([37.0, -22.0])


@both_engines
def test_a_pattern_and_its_copy_have_both_attitudes(sky, engine):
    matcher, ambiguous = Matcher(sky, engine=engine, noise_px=0.5), 0
    frames = frames_of(sky, 20, Noise(0.5, false_stars=2), seed=6)
    for frame in frames:
        copy_px = frame.centroids_px + SHIFT_PX
        inside = sky.camera.contains(copy_px)
        px = np.concatenate([frame.centroids_px, copy_px[inside]])
        found = matcher.identify(px)
        assert found.ok
        if found.other is None:
            continue
        ambiguous += 1
        first, second = sorted(
            (found, found.other), key=lambda one: np.abs(error_arcsec(one, frame.matrix)).max()
        )
        assert np.abs(error_arcsec(first, frame.matrix)[:2]).max() < 200.0
        assert np.abs(error_arcsec(second, frame.matrix)[:2]).max() > 1000.0
        assert not ((first.star_index >= 0) & (second.star_index >= 0)).any()
        assert any(remark.startswith("ambiguous") for remark in found.remarks)
        assert len(found.to_dict()["other"]["stars"]) == len(px)
    assert ambiguous >= 18


@both_engines
def test_frames_with_false_spots_are_not_ambiguous(sky, engine):
    matcher = Matcher(sky, engine=engine, noise_px=0.5)
    for frame in frames_of(sky, 20, Noise(0.5, false_stars=15), seed=7):
        found = matcher.identify(frame.centroids_px)
        assert found.ok
        assert found.other is None
