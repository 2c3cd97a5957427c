"""Every method, and every engine that has it: the same rules for their answers."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, islice

import numpy as np
import pytest
from frames import observe
from scipy.spatial.transform import Rotation
from skies import frame_centred_on, pattern_sky, set_sky

from starcat.database.onboard.layout import DIRECTION_SCALE
from starcat.geometry.attitude import matrix_from_quaternion, matrix_from_radec_roll
from starcat.geometry.camera import Camera
from starcat.geometry.sphere import separation
from starcat.matcher.c_engine import FEATURES, is_compiled
from starcat.matcher.database import MatcherDatabase
from starcat.matcher.matcher import Matcher
from starcat.matcher.methods.table import METHODS
from starcat.pipeline.simulation.selftest import answers_rightly
from starcat.pipeline.simulation.simulate import Noise, SimulatedFrame, simulate_frames

IN_C = {f"{name} in C": name for name in FEATURES}

SKY_PRODUCTS = {
    "triangles": {"pairs", "triangles"},
    "sets": {"hausdorff_angular", "hausdorff_l2"},
    "patterns": {"neighbours", "grid", "radial"},
}
"""The products of each sky of `sky_for`."""

SKIES = {
    name: next((sky for sky, has in SKY_PRODUCTS.items() if has.issuperset(method.products)), None)
    for name, method in METHODS.items()
}


def test_every_method_has_a_sky_and_says_what_it_is():
    assert None not in SKIES.values(), f"no sky of `sky_for` has the products: {SKIES}"
    assert all(method.description for method in METHODS.values())


@pytest.fixture(scope="module")
def sky_for(sky_of):
    return {"triangles": sky_of, "sets": set_sky, "patterns": pattern_sky}


@pytest.fixture(scope="module")
def skies(sky_for, random_directions) -> dict[str, MatcherDatabase]:
    counts = {"triangles": 1200, "sets": 1500, "patterns": 2500}
    return {kind: make(random_directions(counts[kind], 1)) for kind, make in sky_for.items()}


@pytest.fixture(scope="module", params=[*METHODS, *IN_C])
def matcher(skies, request) -> Matcher:
    method = IN_C.get(request.param, request.param)
    if request.param in IN_C and not is_compiled():
        pytest.skip("starcat was installed without a C compiler")
    engine = "c" if request.param in IN_C else "numpy"
    return Matcher(skies[SKIES[method]], method=method, engine=engine)


def hasty(matcher: Matcher) -> Matcher:
    """A matcher that gives up soon, as that in numpy needs seconds for hopeless frames."""
    return matcher if matcher.settings.engine == "c" else matcher.with_settings(max_steps=3000)


def frames(
    matcher: Matcher, count: int, noise: Noise | None = None, seed: int = 3
) -> list[SimulatedFrame]:
    """Frames that the method is made for: for S1's baseline, upright ones about a star."""
    noise, sky = noise or Noise(), matcher.database
    if matcher.settings.method != "hausdorff_l1":
        return list(simulate_frames(sky.directions, sky.camera, count, noise, seed, sky.mag))
    generator, found = np.random.default_rng(seed), []
    for star in generator.choice(len(sky.directions), count):
        px, rows, matrix = frame_centred_on(sky, int(star), 0.0)
        kept = generator.random(len(px)) >= noise.drop_probability
        px = px[kept] + generator.normal(scale=noise.noise_px, size=(kept.sum(), 2))
        px = np.concatenate([px, generator.uniform(0.0, 1024.0, (noise.false_stars, 2))])
        rows = np.append(rows[kept], np.full(noise.false_stars, -1))
        inside = sky.camera.contains(px)
        mag = sky.mag[rows[inside]]
        found.append(SimulatedFrame(matrix, px[inside], rows[inside], mag, rows[inside] < 0))
    return found


def rounding_rad(matcher: Matcher) -> float:
    """Largest error of an attitude without noise: the library rounds the directions of stars.

    Centroids are right to 1e-13 px of 2900 px focal length, 1e-16 rad, and some roundings above it.
    """
    return 4.0 / DIRECTION_SCALE if matcher.settings.engine == "c" else 1e-13


class TestEveryMethod:
    """Properties of the answers of every method."""

    def test_a_clean_frame_is_identified_star_by_star(self, matcher):
        for frame in frames(matcher, 20):
            found = matcher.identify(frame.centroids_px)
            assert found.status == "identified"
            assert found.star_index.tolist() == frame.star_index.tolist()
            ids = matcher.database.star_id[frame.star_index]
            assert found.star_ids.tolist() == ids.tolist()
            assert (found.star_ids.dtype, found.star_index.dtype) == (np.int64, np.int32)
            assert found.n_matched == len(frame.star_index)
            assert found.false_match_probability <= matcher.settings.max_false_match_probability
            matrix = matrix_from_quaternion(found.q_body_from_icrs)
            assert np.abs(matrix - frame.matrix).max() < rounding_rad(matcher)
            assert found.residual_arcsec < np.degrees(rounding_rad(matcher)) * 3600.0
            assert found.dropped == ()

    def test_noise_missing_and_false_stars_give_no_wrong_answer(self, matcher):
        answers = []
        # As many right names and answers as each kind of method gives: triangles the most.
        by_triangles = SKIES[matcher.settings.method] == "triangles"
        count, least_named, least_answered = (40, 0.9, 0.95) if by_triangles else (30, 0.7, 0.92)
        for frame in frames(matcher, count, Noise(0.4, 0.1, 3)):
            found = matcher.identify(frame.centroids_px)
            if found.ok:
                assert answers_rightly(found, frame, matcher)
                named = found.star_index >= 0
                # A false spot near the place of a star can be taken for it.
                assert (found.star_index[named] == frame.star_index[named]).mean() > least_named
            answers.append(found.ok)
        assert np.mean(answers) >= least_answered

    def test_neither_the_order_nor_magnitudes_change_the_answer(self, matcher):
        generator = np.random.default_rng(4)
        for frame in frames(matcher, 5, Noise(0.3, 0.1, 3)):
            order = generator.permutation(len(frame.centroids_px))
            without = matcher.identify(frame.centroids_px)
            rough = frame.mag + generator.normal(scale=0.3, size=len(order))
            some = np.where(np.arange(len(rough)) % 2, rough, np.nan)
            for mag in (None, rough.round(), some, np.full(len(rough), np.nan)):
                one = matcher.identify(frame.centroids_px, mag=mag)
                shuffled = None if mag is None else mag[order]
                other = matcher.identify(frame.centroids_px[order], mag=shuffled)
                assert other.star_ids.tolist() == one.star_ids[order].tolist()
                assert np.array_equal(other.q_body_from_icrs, one.q_body_from_icrs, equal_nan=True)
                if one.ok and without.ok:
                    # The same stars in another order: sums that round differently.
                    assert one.star_ids.tolist() == without.star_ids.tolist()
                    moved = np.abs(one.q_body_from_icrs - without.q_body_from_icrs)
                    assert moved.max() < 1e-13

    def test_candidates_are_as_far_apart_as_the_centroids_and_not_mirrored(self, matcher):
        sky = matcher.database
        u = sky.directions
        for frame in frames(matcher, 3, Noise(0.5, 0.1, 3)):
            seen = observe(frame.centroids_px, sky.camera, 2.0)
            for batch in islice(METHODS[matcher.settings.method].propose(seen, sky), 30):
                for p, q in combinations(range(batch.stars.shape[1]), 2):
                    apart = seen.separation_rad[batch.centroids[:, p], batch.centroids[:, q]]
                    miss = separation(u[batch.stars[:, p]], u[batch.stars[:, q]]) - apart
                    assert np.abs(miss).max(initial=0.0) <= seen.side_tolerance_rad * (1.0 + 1e-6)
                if SKIES[matcher.settings.method] == "triangles" and batch.stars.shape[1] > 2:
                    turned = np.linalg.det(u[batch.stars[:, :3]])
                    assert (turned * np.linalg.det(seen.body[batch.centroids[:, :3]]) > 0.0).all()

    def test_without_magnitudes_nothing_depends_on_brightness(self, matcher):
        if matcher.settings.engine == "c":
            pytest.skip("proposals are those of numpy")
        sky = matcher.database
        fainter = replace(sky, mag=sky.mag[::-1].copy())
        for frame in frames(matcher, 3, Noise(0.5, 0.1, 3)):
            seen, proposed = observe(frame.centroids_px, sky.camera, 2.0), []
            for database in (sky, fainter):
                batches = islice(METHODS[matcher.settings.method].propose(seen, database), 20)
                proposed.append([(b.centroids.tolist(), b.stars.tolist()) for b in batches])
            assert proposed[0]
            assert proposed[0] == proposed[1]

    @pytest.mark.parametrize("axis", [0, 1], ids=["left-right", "upside-down"])
    def test_mirrored_frames_are_never_identified(self, matcher, axis):
        for frame in frames(matcher, 4):
            mirrored_px = frame.centroids_px.copy()
            mirrored_px[:, axis] = 1024.0 - mirrored_px[:, axis]
            assert hasty(matcher).identify(frame.centroids_px).ok
            assert hasty(matcher).identify(mirrored_px).status == "no_match"

    @pytest.mark.parametrize(
        "points",
        [
            np.full((10, 2), 300.0),
            300.0 + 1e-7 * np.arange(20.0).reshape(10, 2) ** 2,
            np.stack([np.linspace(10, 1000, 12), np.full(12, 400.0)], axis=-1),
            np.stack(np.meshgrid(*[np.linspace(100, 900, 4)] * 2), axis=-1).reshape(-1, 2),
        ],
        ids=["one place", "a speck", "a line", "a grid"],
    )
    def test_points_in_odd_places_are_never_identified(self, matcher, points):
        assert not hasty(matcher).identify(points).ok

    def test_few_stars_are_no_match(self, matcher, sky_for):
        # Stars 60 deg apart have no neighbours, and two stars make sets of one.
        octahedron = np.concatenate([np.eye(3), -np.eye(3)])
        pair = np.array([[1.0, 0.0, 0.0], [np.cos(0.05), np.sin(0.05), 0.0]])
        generator, kind = np.random.default_rng(24), SKIES[matcher.settings.method]
        for u in (octahedron, pair, np.eye(3)[:1]):
            lonely = Matcher(
                sky_for[kind](u), method=matcher.settings.method, engine=matcher.settings.engine
            )
            for count in (0, 1, 3, 4, 9):
                found = lonely.identify(generator.uniform(0.0, 1024.0, (count, 2)))
                assert found.status == ("too_few_stars" if count < 4 else "no_match")

    def test_unusable_centroids_get_no_star_and_change_nothing(self, matcher):
        frame, nan, inf = frames(matcher, 1)[0], np.nan, np.inf
        unusable = [[nan, 5], [5, nan], [inf, 5], [5, -inf], [-1, 5], [5, 1024], [1e300, 5]]
        px, repeat = frame.centroids_px, frame.centroids_px[:1]
        found = matcher.identify(np.concatenate([unusable, px, repeat]))
        assert found.star_ids[:7].tolist() == [-1] * 7
        named = found.star_index[7:]
        assert named[1:-1].tolist() == frame.star_index[1:].tolist()
        # Of a centroid and its repeat one is used.
        assert sorted(named[[0, -1]]) == [-1, frame.star_index[0]]
        reasons = [reason for _, reason in sorted(found.dropped)]
        assert reasons == ["not_finite"] * 4 + ["out_of_frame"] * 3 + ["duplicate"]
        without = matcher.identify(px)
        assert np.array_equal(found.q_body_from_icrs, without.q_body_from_icrs)
        assert found.false_match_probability == without.false_match_probability

    def test_attitude_and_residual_are_those_of_the_stars(self, matcher):
        camera: Camera = matcher.database.camera
        for frame in frames(matcher, 10, Noise(0.3)):
            found = matcher.identify(frame.centroids_px)
            q = found.q_body_from_icrs
            angles = found.boresight_ra_deg, found.boresight_dec_deg, found.roll_deg
            assert np.linalg.norm(q) == pytest.approx(1.0, abs=1e-15)
            assert q[3] >= 0.0
            matrix = matrix_from_quaternion(q)
            assert np.abs(matrix - matrix_from_radec_roll(*angles)).max() < 1e-9
            has_star = found.star_index >= 0
            predicted = matcher.database.directions[found.star_index[has_star]] @ matrix.T
            body = camera.directions_from_pixels(frame.centroids_px[has_star])
            expected = np.degrees(np.sqrt(np.mean(np.sum((body - predicted) ** 2, axis=1)))) * 3600
            rounding_arcsec = np.degrees(rounding_rad(matcher)) * 3600.0
            assert found.residual_arcsec == pytest.approx(expected, rel=1e-9, abs=rounding_arcsec)
            best, _ = Rotation.align_vectors(body, predicted @ matrix)
            assert np.abs(best.as_matrix() - matrix).max() < 1e-9
