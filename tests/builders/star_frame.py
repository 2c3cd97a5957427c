"""The last sections of docs/star.md: a simulated frame with the star in it, identified."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from frames import observe
from numpy.typing import NDArray
from star_story import Story, arcsec, link, table

from starcat.geometry.attitude import (
    matrix_from_radec_roll,
    quaternion_from_matrix,
    solve_wahba_svd,
)
from starcat.geometry.kvector import KVector
from starcat.geometry.sphere import radec_from_directions, tangent_axes
from starcat.matcher.matcher import Matcher
from starcat.matcher.methods import triangle
from starcat.matcher.settings import CERTAIN
from starcat.simulation.selftest import HARD, answers_rightly
from starcat.simulation.simulate import Noise, SimulatedFrame, Sky, simulate_frame, simulate_frames
from starcat.stars.star_table import floats_of

Array = NDArray[np.float64]

POINTING, SEED, NOISE_PX = (20.0, 87.0, 30.0), 308, 0.5
DRAWS = 2000
"""Frames of the same pointing, for errors that are not those of one draw."""

NEAR_FRAMES, NEAR_DEG = 200, 6.0
"""Frames whose axis is within so much of the star."""


@dataclass(frozen=True)
class Shot:
    """A simulated frame, and what the matcher says of it."""

    story: Story
    frame: SimulatedFrame
    matcher: Matcher

    @cached_property
    def polaris(self) -> int:
        """Row of the centroid of Polaris."""
        return int(np.flatnonzero(self.frame.star_index == self.story.row)[0])


def take(story: Story) -> Shot:
    matcher = Matcher.open(story.built.folder)
    stars = np.arange(len(story.directions), dtype=np.int32)
    sky = Sky(story.directions, floats_of(story.stars, "mag"), stars)
    generator = np.random.default_rng(SEED)
    matrix, noise = matrix_from_radec_roll(*POINTING), Noise(NOISE_PX)
    frame = simulate_frame(sky, matcher.database.camera, matrix, noise, generator)
    return Shot(story, frame, matcher)


def _triangle_rows(shot: Shot) -> tuple[int, list[tuple[str, object]]]:
    """The first triangle with Polaris: its rank, and how it is looked up."""
    frame, matcher = shot.frame, shot.matcher
    seen = observe(frame.centroids_px, matcher.database.camera, matcher.tolerance_px, frame.mag)
    chosen = triangle.select_triangles(seen)
    polaris = int(np.flatnonzero(seen.rows == shot.polaris)[0])
    rank = int(np.flatnonzero((chosen == polaris).any(axis=1))[0])
    i, j, k = (int(n) for n in chosen[rank])
    sides = seen.separation_rad[[j, i, i], [k, k, j]]
    tolerance_rad = seen.side_tolerance_rad
    area, area_error, radius, radius_error = triangle.features(*sides.tolist(), tolerance_rad)
    product = matcher.database.products["triangles"]
    line = product.numbers["kvector_intercept"], product.numbers["kvector_slope"]
    index = KVector(product["area_rad2"], product["kvector_counts"], *line)
    near = index.range(area - area_error, area + area_error)
    fits = np.abs(product["circumradius_rad"][near] - radius) <= radius_error
    batch = next(triangle.candidates(seen, matcher.database))
    mine = (np.sort(batch.centroids, axis=1) == np.sort(chosen[rank])).all(axis=1)
    named = [", ".join(sorted(map(shot.story.name, stars))) for stars in batch.stars[mine]]
    deg2 = float(np.degrees(np.degrees(1.0)))
    return rank, [
        ("sides", ", ".join(f"{np.degrees(side):.3f}" for side in sides) + " deg"),
        ("area", f"{area * deg2:.3f} ± {area_error * deg2:.3f} deg²"),
        ("circumradius", f"{np.degrees(radius):.3f} ± {np.degrees(radius_error):.3f} deg"),
        ("triangles in the database", f"{len(product['area_rad2']):,}, sorted by area"),
        ("the area fits", f"{near.stop - near.start:,}: rows {near.start:,} to {near.stop - 1:,}"),
        ("the circumradius fits too", int(fits.sum())),
        ("sides and handedness fit too", f"{len(named)}: {'; '.join(named)}"),
    ]


def matcher_section(shot: Shot) -> str:
    frame, camera = shot.frame, shot.matcher.database.camera
    turned = frame.matrix @ shot.story.directions[shot.story.row]
    true_x, true_y = camera.pixels_from_directions(turned[None])[0]
    x, y = frame.centroids_px[shot.polaris]
    body = ", ".join(f"{part:.5f}" for part in turned)
    rank, rows = _triangle_rows(shot)
    return f"""## 9. A frame

Now a camera ({camera.width_px} x {camera.height_px} pixels) looks near the pole, at RA
{POINTING[0]:g}, Dec {POINTING[1]:g} deg. {link("starcat/simulation/simulate.py")} turns every star
by that attitude; the unit vector of Polaris becomes ({body}) in the camera's frame.
{link("starcat/geometry/camera.py")} makes a pixel of it, ({true_x:.1f}, {true_y:.1f}), and
{NOISE_PX} px of noise in each axis (seed {SEED}) move it to ({x:.1f}, {y:.1f}). What the matcher
gets are {len(frame.centroids_px)} such dots and their brightness, in no order and without a name.

{link("starcat/matcher/methods/triangle.py")} takes the brightest dots first. Triangle
{rank + 1} of its list has Polaris in it:

{table(("what", "value"), rows)}

The K-vector ({link("starcat/geometry/kvector.py")}) is why this is fast: a straight line through
the sorted areas says where in the list to begin and where to end, without a search. Handedness
is the sense of rotation: a mirror image is no match."""


def attitude_errors(found: Array, true: Array) -> tuple[Array, Array]:
    """Error of the axis, and about the axis; arcsec, of K attitudes."""
    error = found @ true.T
    about_x, about_y = error[..., 2, 1], error[..., 0, 2]
    about_z = 0.5 * (error[..., 1, 0] - error[..., 0, 1])
    return np.degrees(np.hypot(about_x, about_y)) * 3600, np.degrees(np.abs(about_z)) * 3600


def _rms(values: Array) -> str:
    return f"{float(np.sqrt(np.mean(values**2))):.2f}"


def _least_squares_rows(shot: Shot) -> list[tuple[object, ...]]:
    """Errors of the attitude with the star and without it: of this frame, and of many."""
    frame, camera = shot.frame, shot.matcher.database.camera
    icrs = shot.story.directions[frame.star_index]
    places = camera.pixels_from_directions(icrs @ frame.matrix.T)
    noise = np.random.default_rng(SEED).normal(scale=NOISE_PX, size=(DRAWS, *places.shape))
    draws = camera.directions_from_pixels((places + noise).reshape(-1, 2)).reshape(DRAWS, -1, 3)
    body, rows = camera.directions_from_pixels(frame.centroids_px), []
    others = np.arange(len(icrs)) != shot.polaris
    for title, use in (("with Polaris", np.full(len(icrs), True)), ("without it", others)):
        one = attitude_errors(solve_wahba_svd(body[use], icrs[use])[None], frame.matrix)
        many = attitude_errors(solve_wahba_svd(draws[:, use], icrs[use]), frame.matrix)
        rows.append((title, int(use.sum()), *map(_rms, (*one, *many))))
    return rows


def attitude_section(shot: Shot) -> str:
    frame, matcher = shot.frame, shot.matcher
    result = matcher.identify(frame.centroids_px, mag=frame.mag)
    right = int((result.star_index == frame.star_index).sum())
    q = ", ".join(f"{part:+.5f}" for part in result.q_body_from_icrs)
    truth = ", ".join(f"{part:+.5f}" for part in quaternion_from_matrix(frame.matrix))
    exponent = int(np.floor(np.log10(result.false_match_probability)))
    pixel = arcsec(1.0 / matcher.database.camera.focal_length_px)
    answer = [
        ("status", result.status),
        ("dots with a star", f"{result.n_matched} of {len(frame.mag)}; {right} of them are right"),
        ("residual", f"{result.residual_arcsec:.1f} arcsec; a pixel is {pixel:.1f}"),
        ("false-match probability", f"below 1e{exponent + 1}"),
        ("quaternion found", f"`{q}`"),
        ("quaternion true", f"`{truth}`"),
    ]
    limit = f"{CERTAIN:.0e}".replace("e-0", "e-")
    heads = ("", "stars", "axis", "about it", "axis, rms", "about it, rms")
    return f"""## 10. An attitude

The three stars of a triangle give an attitude. {link("starcat/matcher/verification.py")} asks
whether it explains the rest: it puts all guide stars where they should be on the detector and
counts the dots that are there. How likely is it that chance agrees as well?
{link("starcat/matcher/chance.py")} bounds that, and above {limit} there is no
answer.

{table(("the answer", ""), answer)}

The attitude is the rotation that fits all matched stars best, Polaris among them
({link("starcat/geometry/attitude.py")}: Wahba's problem by singular values). What is one star
worth? The same fit with and without it, errors in arcseconds of the camera's axis and about it;
then the root mean square over {DRAWS:,} such frames with other noise, because one frame is luck:

{table(heads, _least_squares_rows(shot))}"""


def near_rates(shot: Shot, title: str, noise: Noise) -> tuple[str, int, int, int]:
    """Identify frames that look at the star: tried, right and wrong."""
    story, matcher, generator = shot.story, shot.matcher, np.random.default_rng(SEED)
    stars = np.arange(len(story.directions), dtype=np.int32)
    sky = Sky(story.directions, floats_of(story.stars, "mag"), stars)
    east, north = tangent_axes(story.star["ra_deg"], story.star["dec_deg"])
    right = wrong = 0
    for _ in range(NEAR_FRAMES):
        away, angle = np.radians(NEAR_DEG) * np.sqrt(generator.random()), generator.random()
        aside = np.cos(2.0 * np.pi * angle) * east + np.sin(2.0 * np.pi * angle) * north
        axis = story.directions[story.row] + np.tan(away) * aside
        ra_deg, dec_deg = radec_from_directions(axis / np.linalg.norm(axis))
        matrix = matrix_from_radec_roll(float(ra_deg), float(dec_deg), 360.0 * generator.random())
        frame = simulate_frame(sky, matcher.database.camera, matrix, noise, generator)
        result = matcher.identify(frame.centroids_px)
        is_right = result.status == "identified" and answers_rightly(result, frame, matcher)
        right += is_right
        wrong += result.status == "identified" and not is_right
    return title, NEAR_FRAMES, right, wrong


def evaluation_section(shot: Shot) -> str:
    story, database = shot.story, shot.matcher.database
    wanted = story.spec.self_test
    noise = Noise(wanted.noise_px, noise_mag=wanted.noise_mag)
    frames = simulate_frames(
        database.directions, database.camera, wanted.frames, noise, wanted.seed, database.mag
    )
    with_polaris = sum(story.row in frame.star_index for frame in frames)
    rows = [
        (f"self-test, {rate.name}", rate.frames, rate.identified, rate.wrong)
        for rate in story.built.rates
    ]
    rows.append(near_rates(shot, "at Polaris, clean", Noise(wanted.noise_px)))
    rows.append(near_rates(shot, "at Polaris, hard", Noise(wanted.noise_px, **HARD)))
    return f"""## 11. Does it work anywhere else?

One frame proves little. Before a build ends, {link("starcat/simulation/selftest.py")} lets the
new database identify {wanted.frames} clean frames of random attitudes and {wanted.frames} hard
ones, with {HARD["drop_probability"]:.0%} of the stars missing and {HARD["false_stars"]} false dots
added; a single wrong answer fails the build. A frame is a small part of the sky: Polaris is in
{with_polaris or "none"} of the clean ones. So here are as many whose axis
is within {NEAR_DEG:g} deg of it, with Polaris in every frame:

{table(("frames", "tried", "right", "wrong"), rows)}

What is not right has no answer at all: a tracker can wait for the next frame, but not live with a
wrong one. `starcat evaluate` goes on from there, with more noise and other methods, and
[reproduction.md](reproduction.md) has it beside what five papers print."""
