"""Plans: the guide stars that a sensor will see at many attitudes, and the resulting accuracy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from starcat.arguments import HasFolder, database_path, path_of
from starcat.arrays import Array
from starcat.catalog.stars.star_table import directions_of, floats_of
from starcat.database.reader import DatabaseFolder, open_database_folder
from starcat.errors import ConfigError
from starcat.frames.planning.acquisition import acquisition_probability, expected_errors_arcsec
from starcat.frames.planning.attitudes import Orbit, PlannedAttitudes, attitudes_of, orbit_of
from starcat.frames.planning.drawing import draw_plan
from starcat.frames.planning.options import PLANNED, PlanOptions
from starcat.frames.planning.plan_result import Expected, Plan, PlannedStars
from starcat.frames.sky.bodies import bodies_seen
from starcat.frames.sky.in_time import FAINTER_MAG, earth_limb_angle_deg
from starcat.frames.sky.observer import Observer, aberrated
from starcat.geometry.camera import Camera
from starcat.geometry.sphere import chord_from_separation, directions_from_radec, separation
from starcat.matcher.database import MatcherDatabase, open_database
from starcat.matcher.settings import NOISE_DEVIATIONS, REACH
from starcat.matcher.stars import ARCSEC
from starcat.pipeline.specs.reading import spec_of_database
from starcat.resources import PathLike
from starcat.storage.figures import check_kind

BLOCK = 2000
"""Number of attitudes that are planned at once."""

MIN_DETECTION = 0.001
"""Stars that are less likely to be detected are not listed."""

NEAREST_RAD = np.radians(0.01)
"""Margin of the search for stars, which aberration displaces by 0.006 deg."""


def plan(
    database: HasFolder | PathLike,
    attitudes: Any,
    *,
    orbit: Any = None,
    alignment: ArrayLike | None = None,
    camera: Camera | None = None,
    plot: PathLike | None = None,
    **expected: Any,
) -> Plan:
    """Plan the stars and errors of a star sensor at many attitudes, like ``starcat plan``.

    Parameters
    ----------
    database : Database, str or path-like
        The result of `starcat.open`, or the folder of a database.
    attitudes : path, table or array_like of float64, shape (K, 4)
        A CSV file, a CCSDS AEM (KVN), or a table (mapping, astropy, pandas, Arrow) with ``time``
        (UTC) and either ``q_body_from_icrs``, or ``qx`` to ``qw``, or ``ra_deg``, ``dec_deg`` and
        ``roll_deg``; or quaternions alone, scalar last.
    orbit : path or table, optional
        ``time``, ``x_km`` to ``z_km`` and ``vx_km_s`` to ``vz_km_s`` from the Earth in ICRS axes,
        or a CCSDS OEM (KVN). Without it the limb of the Earth, and aberration by the motion
        around the Earth, are left out.
    alignment : array_like of float64, shape (4,), optional
        Quaternion from the frame of the attitudes to the camera frame; by default they are equal.
    camera : Camera, optional
        By default the database's camera.
    plot : str or path-like, optional
        PNG or SVG file to write, with the plan over time.
    **expected
        ``noise_px`` and ``noise_mag`` (by default the values of the spec's self-test),
        ``limit_mag``, ``drop_probability``, ``false_stars``, ``window_arcsec`` (20 px),
        ``lookalike_mag`` (1), ``keep_out_deg`` (mapping of the body to degrees),
        ``min_acquisition`` (0.9) and ``max_false_match_probability``: the fields of
        `starcat.frames.planning.plan_result.Expected`.

    Returns
    -------
    Plan
        Errors, probabilities of acquisition, stars, bodies and gaps; `Plan.to_dict`, `Plan.best`.

    Raises
    ------
    ConfigError, ProductError
        In the same cases as ``starcat plan``.
    """
    drawing = None if plot is None else path_of("plot", plot)
    check_kind(drawing)
    folder = database_path("database", database)
    names = ("keep_out_deg", *PLANNED)
    unknown = sorted(set(expected) - set(names))
    if unknown:
        raise TypeError(f"plan has no argument {unknown[0]!r}; expected one of {', '.join(names)}")
    keep_out_deg = expected.pop("keep_out_deg", None)
    opened, sky = open_database_folder(folder), open_database(folder)
    eye, test = camera or sky.camera, spec_of_database(opened).self_test
    options = PlanOptions(**expected)
    conditions = Expected(
        test.noise_px if options.noise_px is None else options.noise_px,
        test.noise_mag if options.noise_mag is None else options.noise_mag,
        options.limit_mag,
        options.drop_probability,
        options.false_stars,
        20.0 * eye.pixel_arcsec if options.window_arcsec is None else options.window_arcsec,
        options.lookalike_mag,
        dict(keep_out_deg or {}),
        options.min_acquisition,
        options.max_false_match_probability,
    )
    planned = attitudes_of(attitudes, alignment)
    observers = _observers(planned, None if orbit is None else orbit_of(orbit))
    angles, bodies, hidden = _surroundings(planned, observers, eye, sky)
    for name in conditions.keep_out_deg:
        if name not in angles:
            needed = "attitudes with a time" if observers is None else "an orbit"
            raise ConfigError(
                f"the angle of {name} needs {needed}",
                parameter="keep_out_deg",
                hint=() if observers is None else "give it with {orbit}",
            )
    blocks = [
        _planned_block(sky, planned, observers, hidden, eye, conditions, bodies, first)
        for first in range(0, len(planned.matrices), BLOCK)
    ]

    def joined(name: str) -> Any:
        return np.concatenate([getattr(block, name) for block in blocks])

    contamination, offset_px = _blends(opened, sky, eye)
    result = Plan(
        sky,
        eye,
        conditions,
        planned,
        joined("error_arcsec"),
        joined("acquisition"),
        joined("stars_expected"),
        angles,
        bodies,
        PlannedStars(*(joined(name) for name in PlannedStars.__dataclass_fields__)),
        _lookalikes(opened, sky, conditions),
        contamination,
        offset_px,
    )
    if drawing is not None:
        draw_plan(result, drawing)
    return result


def _observers(planned: PlannedAttitudes, orbit: Orbit | None) -> list[Observer] | None:
    if planned.times is None:
        if orbit is not None:
            raise ConfigError(
                "orbit is given, but the attitudes have no time", hint="add a column time"
            )
        return None
    if orbit is not None:
        return orbit.observers(planned.times)
    return [Observer.at(time) for time in planned.times]


@dataclass(frozen=True)
class _Disc:
    """A disc that hides stars."""

    direction: Array
    radius_rad: float


_Bodies = tuple[tuple[dict[str, Any], ...], ...]


def _surroundings(
    planned: PlannedAttitudes,
    observers: list[Observer] | None,
    camera: Camera,
    database: MatcherDatabase,
) -> tuple[dict[str, Array], _Bodies, list[list[_Disc]]]:
    """Return angles of bodies, bodies in the frames, and discs that hide stars, by attitude."""
    if observers is None:
        count = len(planned.matrices)
        return {}, ((),) * count, [[] for _ in range(count)]
    faintest = float(database.mag.max()) + FAINTER_MAG
    angles, in_frame, hidden = [], [], []
    for observer, matrix in zip(observers, planned.matrices, strict=True):
        seen = bodies_seen(observer)
        angle = np.degrees(separation(seen.directions, matrix[2]))
        px = camera.pixels_from_directions(seen.directions @ matrix.T)
        inside = camera.contains(px) & (seen.mag <= faintest)
        if observer.is_placed:
            limb = earth_limb_angle_deg(matrix[2], observer)
            angle[seen.row("Earth")] = limb
            inside[seen.row("Earth")] = False
        angles.append(angle)
        in_frame.append(
            tuple(
                {
                    "name": seen.names[k],
                    "x_px": float(px[k, 0]),
                    "y_px": float(px[k, 1]),
                    "mag": float(seen.mag[k]),
                }
                for k in np.flatnonzero(inside)
            )
        )
        large = np.flatnonzero(seen.radius_rad > 0.1 / camera.focal_length_px)
        discs = zip(seen.directions[large], seen.radius_rad[large].tolist(), strict=True)
        hidden.append([_Disc(*disc) for disc in discs])
    return dict(zip(seen.names, np.array(angles).T, strict=True)), tuple(in_frame), hidden


@dataclass(frozen=True, eq=False)
class _Block(PlannedStars):
    """The stars of some attitudes, and the resulting accuracy and acquisition."""

    error_arcsec: Array
    acquisition: Array
    stars_expected: Array


def _planned_block(
    database: MatcherDatabase,
    planned: PlannedAttitudes,
    observers: list[Observer] | None,
    hidden: list[list[_Disc]],
    camera: Camera,
    expected: Expected,
    bodies: _Bodies,
    first: int,
) -> _Block:
    """Return what is planned for `BLOCK` attitudes from the first one on."""
    matrices = planned.matrices[first : first + BLOCK]
    count = len(matrices)
    margin_px = REACH * NOISE_DEVIATIONS * expected.noise_px
    reach = camera.radius_rad + NEAREST_RAD + margin_px / camera.focal_length_px
    tree = scipy.spatial.cKDTree(matrices[:, 2])
    of_stars = scipy.spatial.cKDTree(database.directions)
    near = tree.sparse_distance_matrix(
        of_stars, chord_from_separation(min(reach, np.pi)), output_type="ndarray"
    )
    order = np.lexsort((near["j"], database.mag[near["j"]], near["i"]))
    group, star = near["i"][order].astype(np.int64), near["j"][order].astype(np.int64)
    u = database.directions[star]
    if observers is not None:
        velocity = np.array(
            [observer.velocity_km_s for observer in observers[first : first + count]]
        )
        u = aberrated(u, velocity[group])
    body = np.einsum("pij,pj->pi", matrices[group], u)
    px = camera.pixels_from_directions(body)
    around = np.abs(px - camera.middle_px) <= camera.middle_px + margin_px
    in_frame = np.bincount(group[around.all(axis=1)], minlength=count)
    detection = _detection(database.mag[star], expected)
    for row, discs in enumerate(hidden[first : first + count]):
        rows = slice(*np.searchsorted(group, [row, row + 1]))
        for disc in discs:
            detection[rows][separation(u[rows], disc.direction) < disc.radius_rad] = 0.0
    kept = camera.contains(px) & (detection >= MIN_DETECTION)
    body, px, detection = body[kept], px[kept], detection[kept]
    group, star = group[kept], star[kept]
    false = np.array([len(seen) for seen in bodies[first : first + count]])
    noise_px = expected.noise_px
    acquisition = acquisition_probability(
        body, detection, group, in_frame, false + expected.false_stars, camera, noise_px,
        expected.max_false_match_probability,
    )  # fmt: skip
    return _Block(
        group + first,
        star,
        px,
        detection,
        expected_errors_arcsec(body, px, detection, group, count, camera, noise_px),
        acquisition,
        np.bincount(group, detection, count).astype(np.float64),
    )


def _detection(mag: Array, expected: Expected) -> Array:
    """Return the probability of stars to be detected."""
    seen = np.full(len(mag), 1.0 - expected.drop_probability)
    if expected.limit_mag is None:
        return seen
    if expected.noise_mag == 0.0:
        return seen * (mag <= expected.limit_mag)
    return np.asarray(seen * scipy.special.ndtr((expected.limit_mag - mag) / expected.noise_mag))


def _lookalikes(
    opened: DatabaseFolder, database: MatcherDatabase, expected: Expected
) -> NDArray[np.int64]:
    """Count the records of the catalog that can be taken for each star, rejected ones included."""
    directions, mags = [database.directions], [database.mag]
    if "rejected" in opened.products:
        rejected = opened.table("rejected")
        mag = floats_of(rejected, "mag")
        ra_deg, dec_deg = (floats_of(rejected, name) for name in ("ra_deg", "dec_deg"))
        bright = mag <= float(database.mag.max()) + expected.lookalike_mag
        bright &= np.isfinite(ra_deg + dec_deg)
        directions.append(directions_from_radec(ra_deg[bright], dec_deg[bright]))
        mags.append(mag[bright])
    u, mag = np.concatenate(directions), np.concatenate(mags)
    radius = chord_from_separation(expected.window_arcsec / ARCSEC)
    stars, others = scipy.spatial.cKDTree(database.directions), scipy.spatial.cKDTree(u)
    near = stars.sparse_distance_matrix(others, radius, output_type="ndarray")
    alike = np.abs(database.mag[near["i"]] - mag[near["j"]]) <= expected.lookalike_mag
    alike &= near["i"] != near["j"]
    return np.bincount(near["i"][alike], minlength=len(database.mag)).astype(np.int64)


def _blends(
    opened: DatabaseFolder, database: MatcherDatabase, camera: Camera
) -> tuple[Array, Array]:
    """Return the contamination and the centroid offset, px, of each star from the build."""
    table = opened.stars
    # The stars of an onboard image are in another order, and numbers of two catalogs can be equal.
    _, nearest = scipy.spatial.cKDTree(directions_of(table)).query(database.directions)
    rows = np.asarray(nearest, dtype=np.int64)
    columns = []
    for name in ("contamination", "centroid_offset_arcsec"):
        is_there = name in table.column_names
        columns.append(floats_of(table, name)[rows] if is_there else np.full(len(rows), np.nan))
    return columns[0], columns[1] / camera.pixel_arcsec
