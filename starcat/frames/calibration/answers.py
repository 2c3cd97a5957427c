"""Answers of ``starcat identify`` as arrays: position and brightness of each star, seen or not.

A file holds one line of JSON per frame, as ``--ndjson`` prints them, or a JSON value of all frames.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array, Directions
from starcat.errors import ConfigError, FileMissing, SourceError
from starcat.geometry.attitude import matrix_from_quaternion
from starcat.geometry.camera import Camera
from starcat.geometry.distortion import Distortion
from starcat.geometry.sphere import Zones, zones_of
from starcat.storage.regular_files import read_regular_file

EDGE_PX = 5.0
"""A star that should be nearer to the edge of the frame is not expected to be seen."""

MAKE_THEM = "make it with 'starcat identify DATABASE FRAMES --ndjson > answers.ndjson'"

MAX_BYTES = 4 << 30
"""Largest size of a file of answers."""

_ARCSEC = np.degrees(1.0) * 3600.0
_SAME_MAG = 1e-6


@dataclass(frozen=True)
class SkyStars:
    """The guide stars of a database, one row each."""

    name: str  # name of the database, ``<name>-<version>``
    star_id: NDArray[np.int64]
    designation: tuple[str, ...]
    directions: Directions
    mag: Array
    colour: Array  # colour in one pair of bands; NaN for a star without one
    catalog: tuple[str, ...] = ()  # catalog of each star, if several are merged

    def __len__(self) -> int:
        return len(self.mag)

    def number_of(self, row: int) -> int | str:
        """Return the number of a star, with its catalog if another star has the number, too."""
        number = int(self.star_id[row])
        if not self.catalog or np.count_nonzero(self.star_id == number) == 1:
            return number
        return f"{self.catalog[row]} {number}"


@dataclass(frozen=True)
class Sightings:
    """The stars that should be in identified frames, one row per star and frame."""

    frame: NDArray[np.int64]  # number of the frame, ascending
    star: NDArray[np.int64]  # row of the database
    is_seen: NDArray[np.bool_]  # true if a centroid was identified as the star
    mag: Array  # measured magnitude; NaN unless seen and measured
    offset_arcsec: Array  # seen minus database, east and north; NaN unless seen; shape (N, 2)

    def __len__(self) -> int:
        return len(self.frame)


@dataclass(frozen=True)
class Answers:
    """The contents of files of answers."""

    names: tuple[str, ...]  # names of the identified frames
    n_frames: int  # number of all frames
    sightings: Sightings


def read_answers(paths: Sequence[Path], stars: SkyStars) -> Answers:
    """Read the identified frames of files, and find which stars each should show."""
    row_of = _rows_of_names(stars)
    zones = zones_of(stars.directions)
    names, parts, count = list[str](), list[tuple[NDArray[Any], ...]](), 0
    for path in paths:
        for where, answer in _answers_of(path):
            count += 1
            if answer["status"] != "identified":
                continue
            seen = _seen_stars(answer, stars, row_of, where)
            parts.append(_columns_of_frame(answer, seen, stars, zones, len(names), where))
            names.append(str(answer.get("frame", where)))
    if not names:
        raise ConfigError(
            f"none of the {count} frames of {', '.join(str(path) for path in paths[:3])} is "
            "identified, so nothing can be learnt",
            hint="'starcat identify' shows the reason for each",
        )
    frame, star, is_seen, mag, offset = (
        np.concatenate(column) for column in zip(*parts, strict=True)
    )
    if np.isnan(mag).all():
        raise ConfigError(
            "no centroid of a star has a magnitude",
            where=paths[0],
            hint="give 'starcat identify' frames with a column mag or flux",
        )
    return Answers(tuple(names), count, Sightings(frame, star, is_seen, mag, offset))


def _rows_of_names(stars: SkyStars) -> dict[tuple[int, str], int]:
    """Return the row of each number and name; a number that only one star has is also without."""
    numbers = stars.star_id.tolist()
    named = zip(numbers, stars.designation, strict=True)
    rows = {(number, name): row for row, (number, name) in enumerate(named)}
    count = Counter(numbers)
    rows |= {(number, ""): row for row, number in enumerate(numbers) if count[number] == 1}
    return rows


def _answers_of(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Return each answer of a file, and where in the file it is."""
    try:
        text = read_regular_file(path, MAX_BYTES).decode("utf-8-sig")
    except FileMissing:
        raise FileMissing("no such file", where=path, hint=MAKE_THEM) from None
    except SourceError as error:
        raise ConfigError(str(error), hint=MAKE_THEM) from error
    except UnicodeDecodeError as error:
        raise ConfigError("cannot be read (not text)", where=path, hint=MAKE_THEM) from error
    if not text.strip():
        raise ConfigError("the file is empty", where=path, hint=MAKE_THEM)
    for where, answer in _values_of(text, path):
        if not isinstance(answer, dict) or "status" not in answer:
            raise ConfigError(
                "no answer of 'starcat identify', which is an object with the key 'status'",
                where=where,
                hint=MAKE_THEM,
            )
        yield where, answer


def _values_of(text: str, path: Path) -> Iterator[tuple[str, Any]]:
    if text.lstrip().startswith("["):
        try:
            for number, answer in enumerate(json.loads(text), start=1):
                yield f"{path}: frame {number}", answer
        except (ValueError, RecursionError) as error:
            raise ConfigError(f"not JSON ({error})", where=path, hint=MAKE_THEM) from error
        return
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip():
            continue
        try:
            yield f"{path}: line {number}", json.loads(line)
        except (ValueError, RecursionError) as error:
            raise ConfigError(
                f"line {number} is not JSON ({error}); expected one line per frame: {MAKE_THEM}",
                where=path,
            ) from error


@dataclass(frozen=True)
class _Seen:
    """The centroids of a frame that are stars."""

    row: NDArray[np.int64]
    px: Array
    mag: Array


def _seen_stars(
    answer: dict[str, Any], stars: SkyStars, row_of: dict[tuple[int, str], int], where: str
) -> _Seen:
    """Return the stars of an answer, which must have been found with the same database."""
    database_name = answer.get("database")
    if database_name is not None and database_name != stars.name:
        raise ConfigError(
            f"identified with the database {database_name}, this is {stars.name}",
            where=where,
            hint="give the database that the frames were identified with, or identify them again",
        )
    try:
        centroids = [centroid for centroid in answer["stars"] if centroid["star"] is not None]
        keys = [(int(centroid["star_id"]), str(centroid["star"])) for centroid in centroids]
        # An onboard image has numbers without names.
        rows = [row_of.get(key, row_of.get((key[0], ""), -1)) for key in keys]
        mags = [float(centroid["mag"]) for centroid in centroids]
        px = [[float(centroid["x_px"]), float(centroid["y_px"])] for centroid in centroids]
        mag = [
            float("nan" if (m := centroid["observed_mag"]) is None else m) for centroid in centroids
        ]
    except (KeyError, TypeError, ValueError) as error:
        raise ConfigError(
            f"the stars are not as this starcat writes them ({error!r})",
            where=where,
            hint="identify the frames again",
        ) from error
    for row, centroid, brightness in zip(rows, centroids, mags, strict=True):
        if row < 0 or abs(stars.mag[row] - brightness) > _SAME_MAG:
            raise ConfigError(
                f"{centroid['star']} with magnitude {brightness:g} is not a star of {stars.name}",
                where=where,
                hint="give the database that the frames were identified with",
            )
    return _Seen(
        np.array(rows, dtype=np.int64), np.array(px).reshape(-1, 2), np.array(mag, dtype=np.float64)
    )


def _columns_of_frame(
    answer: dict[str, Any], seen: _Seen, stars: SkyStars, zones: Zones, number: int, where: str
) -> tuple[NDArray[Any], ...]:
    """Return the columns of `Sightings` of a frame: the stars that are seen, then the others."""
    camera, matrix = _camera_of(answer, where), _matrix_of(answer, where)
    near = zones.near(matrix[2], 1.05 * camera.radius_rad)
    near = near[~np.isin(near, seen.row)]
    body = stars.directions[near] @ matrix.T
    px = camera.pixels_from_directions(body)
    size = np.array([camera.width_px, camera.height_px])
    inside = ((px > EDGE_PX) & (px < size - EDGE_PX)).all(axis=1)
    missed = near[inside]
    count, n_missed = len(seen.row) + len(missed), len(missed)
    offset = camera.directions_from_pixels(seen.px) @ matrix - stars.directions[seen.row]
    return (
        np.full(count, number),
        np.concatenate([seen.row, missed]),
        np.arange(count) < len(seen.row),
        np.concatenate([seen.mag, np.full(n_missed, np.nan)]),
        np.concatenate(
            [_on_the_sky(offset, stars.directions[seen.row]), np.full((n_missed, 2), np.nan)]
        ),
    )


def _on_the_sky(offset: Array, directions: Directions) -> Array:
    """Return small offsets of directions as arcseconds to the east and to the north."""
    x, y, z = directions.T
    level = np.maximum(np.hypot(x, y), 1e-12)
    east = (x * offset[:, 1] - y * offset[:, 0]) / level
    north = level * offset[:, 2] - z * (x * offset[:, 0] + y * offset[:, 1]) / level
    return np.column_stack([_ARCSEC * east, _ARCSEC * north])


def _camera_of(answer: dict[str, Any], where: str) -> Camera:
    try:
        content = dict(answer["camera"])
        return Camera(**{**content, "distortion": Distortion(**content["distortion"])})
    except (KeyError, TypeError, ValueError) as error:
        raise ConfigError(
            f"no camera that this starcat writes ({error!r})",
            where=where,
            hint="identify the frames again",
        ) from error


def _matrix_of(answer: dict[str, Any], where: str) -> Array:
    try:
        q = np.array(answer["q_body_from_icrs"], dtype=np.float64).reshape(4)
        return matrix_from_quaternion(q)
    except (KeyError, TypeError, ValueError, ZeroDivisionError) as error:
        raise ConfigError(
            f"no attitude that this starcat writes ({error!r})",
            where=where,
            hint="identify the frames again",
        ) from error
