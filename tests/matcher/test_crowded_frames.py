"""Frames of more centroids than a search takes, and batches with one odd frame."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from frames import ENGINES, assert_same, both_engines, frames_of, needs_c

from starcat.matcher import matcher
from starcat.matcher.batch import BatchResult
from starcat.matcher.brightest import MAX_CENTROIDS, brightest_of
from starcat.matcher.matcher import Matcher
from starcat.matcher.methods.table import METHODS
from starcat.matcher.observation import as_frame
from starcat.matcher.tracking import Tracker
from starcat.pipeline.simulation.simulate import Noise

SMALL = 50_000_000  # bytes; the distances between all of 50,000 centroids would be 20 GB


def crowded(sky, count, seed=3):
    """Return a frame of stars among fainter spots, in a random order, and the true stars."""
    [frame] = frames_of(sky, 1, Noise(0.3, noise_mag=0.1), seed=seed)
    random = np.random.default_rng(seed)
    faint = count - len(frame.mag)
    size = sky.camera.width_px, sky.camera.height_px
    px = np.concatenate([frame.centroids_px, random.random((faint, 2)) * size])
    mag = np.concatenate([frame.mag, random.uniform(20.0, 25.0, faint)])
    stars = np.concatenate([frame.star_index, np.full(faint, -1)])
    order = random.permutation(count)
    return px[order], mag[order], stars[order]


@both_engines
def test_fifty_thousand_centroids_take_little_memory_however_they_are_asked(sky, engine):
    px, mag, stars = crowded(sky, 50_000)
    one = Matcher(sky, engine=engine)
    alone = one.identify(px[stars >= 0], mag=mag[stars >= 0])
    tracker = Tracker(one)
    tracker.identify(px, mag=mag)
    near = {"prior": alone.q_body_from_icrs, "prior_error_deg": 0.5}
    asked = {
        "identify": lambda: one.identify(px, mag=mag),
        "prior": lambda: one.identify(px, mag=mag, **near),
        "scale": lambda: one.identify(px, mag=mag, fov_error=0.02),
        "many": lambda: one.identify_many([px, px], mag=[mag, mag])[1],
        "tracking": lambda: tracker.identify(px, mag=mag),
    }
    for name, ask in asked.items():
        tracemalloc.start()
        found = ask()
        index = found.star_index
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < SMALL, name
        assert found.ok, name
        assert (index[index >= 0] == stars[index >= 0]).all(), name
        assert found.n_matched >= 0.9 * alone.n_matched, name
        assert found.n_not_searched == 50_000 - MAX_CENTROIDS, name
        assert "512 of 50000 centroids were searched" in found.remarks[0], name
    # Without magnitudes no star may stand out, but the search ends.
    assert one.identify(px).n_not_searched == 50_000 - MAX_CENTROIDS


def test_what_is_searched_depends_neither_on_order_nor_on_position(sky):
    random = np.random.default_rng(5)
    px = random.random((20_000, 2)) * (sky.camera.width_px, sky.camera.height_px)
    px[:3], px[3], px[4] = px[5], (-1.0, 2.0), np.nan
    for mag in (None, np.full(20_000, np.nan), random.integers(0, 3, 20_000).astype(float)):
        part = brightest_of(as_frame(px, sky.camera, mag))
        chosen = {tuple(pair) for pair in px[part.rows]}
        assert len(chosen) == len(part.rows) == MAX_CENTROIDS
        order = random.permutation(20_000)
        other = brightest_of(as_frame(px[order], sky.camera, None if mag is None else mag[order]))
        assert {tuple(pair) for pair in px[order][other.rows]} == chosen
        assert {(3, "out_of_frame"), (4, "not_finite")} <= set(part.dropped)
        # Uniform over the frame: the mean within 4 standard errors of the middle, as is the spread.
        off = (px[part.rows] - sky.camera.middle_px) / sky.camera.middle_px
        assert np.abs(off.mean(axis=0)).max() < 4.0 * np.sqrt(1 / 3 / MAX_CENTROIDS)
        assert np.abs((off**2).mean(axis=0) - 1 / 3).max() < 4.0 * np.sqrt(4 / 45 / MAX_CENTROIDS)
    same = np.repeat(px[5:6], 1000, axis=0)
    assert brightest_of(as_frame(same, sky.camera)).rows.tolist() == [0]


@needs_c
def test_one_odd_frame_leaves_the_others_to_the_c_library(sky, monkeypatch):
    frames = frames_of(sky, 6, Noise(0.3, noise_mag=0.1), seed=9)
    px, mags = [frame.centroids_px for frame in frames], [frame.mag for frame in frames]
    px[2], mags[2], _ = crowded(sky, 700)
    sigma = [np.full(len(mag), 0.3) for mag in mags]
    sigma[4][0] = 1e7  # beyond the limits of the library
    asked, run = [], matcher.solve
    noted = lambda *args, **more: asked.append(1) or run(*args, **more)  # noqa: E731
    monkeypatch.setattr(matcher, "solve", noted)
    one = Matcher(sky, engine="c")
    found = one.identify_many(px, mag=mags, sigma_px=sigma)
    assert len(asked) == 1
    assert found.status == ["identified"] * 6
    for n, answer in enumerate(found):
        alone = one.identify(px[n], mag=mags[n], sigma_px=sigma[n])
        assert answer.star_index.tolist() == alone.star_index.tolist()
        assert answer.n_not_searched == alone.n_not_searched == (188 if n == 2 else 0)
        assert np.array_equal(answer.q_body_from_icrs, found.q_body_from_icrs[n])
        assert np.array_equal(answer.q_body_from_icrs, alone.q_body_from_icrs)


@pytest.mark.parametrize("method", METHODS)
def test_all_methods_answer_many_frames_alike(small_database, method):
    one = Matcher.open(small_database, method)
    [frame] = frames_of(one.database, 1, seed=2)
    found = one.identify_many(iter([frame.centroids_px, np.empty((0, 2))]))
    assert isinstance(found, BatchResult)
    assert found.status[1] == "too_few_stars"
    assert found.seconds.shape == (2,)
    assert found.q_body_from_icrs.shape == (2, 4)
    assert [answer.status for answer in found] == found.status
    # An answer is true if it identifies.
    assert [bool(answer) for answer in found] == [found[0].ok, False]
    assert bool(found)
    assert not all(found)
    none = one.identify_many([])
    assert isinstance(none, BatchResult)
    assert not none


@pytest.mark.parametrize("value", [1e308, -1e308, 4e38, 101.0, np.inf])
def test_a_magnitude_of_no_star_is_as_unknown_as_nan(sky, value):
    for frame in frames_of(sky, 8, Noise(0.5, 0.1, 3, noise_mag=0.3), seed=4):
        strange, unknown, answers = frame.mag.copy(), frame.mag.copy(), []
        strange[::5], unknown[::5] = value, np.nan
        for engine in ENGINES:
            one = Matcher(sky, engine=engine, noise_mag=0.3)
            answers.append(one.identify(frame.centroids_px, mag=strange))
            expected = one.identify(frame.centroids_px, mag=unknown)
            assert answers[-1].star_index.tolist() == expected.star_index.tolist()
        assert_same(answers[-1], answers[0])
        reasons = {found.refusal and found.refusal.reason for found in answers}
        assert len(reasons) == 1
