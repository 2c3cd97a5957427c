"""From files to answers and back: frames in files, what the matcher says of them, pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from starcat.errors import ConfigError
from starcat.geometry.attitude import matrix_from_quaternion
from starcat.geometry.camera import Camera
from starcat.matcher.centroids import (
    MeasuredFrame,
    read_frames,
    write_centroids,
)
from starcat.matcher.database import Database
from starcat.matcher.matcher import Matcher
from starcat.matcher.result import MatchResult
from starcat.matcher.settings import SCALE_FREE
from starcat.matcher.tracking import Tracker
from starcat.simulation.simulate import Frame

if TYPE_CHECKING:
    from starcat.sky.in_time import SkyInTime
    from starcat.sky.observer import Observer

IMAGE_SUFFIXES = (
    ".fits", ".fit", ".fts", ".gz", ".fz", ".png", ".tif", ".tiff", ".jpg", ".jpeg",
)  # fmt: skip
"""Files that are read as images; all others hold centroids."""

FOV_ERROR_OF_IMAGES = 0.02
"""Error of the focal length that is allowed for an image where none is stated: who describes a
camera by its data sheet is seldom farther off."""

Near = Tracker | tuple[list[float], float]
"""What says where frames are expected: a tracker, or an attitude and its largest error, degrees."""

CENTROIDS_SUFFIX = ".csv"
"""Suffix of the file that a simulated frame's centroids are written to."""


@dataclass(frozen=True)
class MeasuredFile:
    """What a file holds.

    Attributes
    ----------
    frames : sequence of MeasuredFrame
        Centroids.
    image : ndarray, shape (height, width), or None
        The picture that they were found in.
    """

    frames: Sequence[MeasuredFrame]
    image: NDArray[Any] | None = None


@dataclass(frozen=True)
class PictureOptions:
    """How a picture is read, and spots are found in it.

    Attributes
    ----------
    threshold_sigma, psf_sigma_px, most_spots
        As those of `find_spots`. The matcher gets the brightest 200 spots: measured, further
        ones find no further picture, and each costs time.
    plane : int, optional
        Plane of a FITS cube, counted from 0.
    is_mosaic : bool
        Whether the pixels are behind a mosaic of colour filters.
    dark : Path, optional
        Image with the lid on, which is subtracted.
    mask : Path, optional
        Image that is not zero where no stars are wanted.
    """

    threshold_sigma: float = 5.0
    psf_sigma_px: float | None = None
    most_spots: int = 200
    plane: int | None = None
    is_mosaic: bool = False
    dark: Path | None = None
    mask: Path | None = None


def measure(
    path: Path, *, flip: bool | None = None, options: PictureOptions | None = None
) -> MeasuredFile:
    """Read centroids, or find them in an image."""
    if path.suffix.lower() not in IMAGE_SUFFIXES:
        return MeasuredFile(read_frames(path))
    from starcat.images.centroiding import find_spots

    how = options or PictureOptions()
    image = read_picture(path, flip, how)
    try:
        spots = find_spots(
            image,
            threshold_sigma=how.threshold_sigma,
            psf_sigma_px=how.psf_sigma_px,
            most_spots=how.most_spots,
        )
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}", key=error.key, value=error.value) from error
    return MeasuredFile([MeasuredFrame(path.stem, spots.centroids_px, spots.mag)], image)


def read_picture(path: Path, flip: bool | None, options: PictureOptions) -> NDArray[Any]:
    """Read an image and repair it as the options say: dark frame, mask, mosaic."""
    from starcat.images.frame_repair import grey_of_mosaic, without_dark, without_dead_zones
    from starcat.images.image_file import read_image

    image: NDArray[Any] = read_image(path, flip=flip, plane=options.plane)
    if options.dark is not None:
        image = without_dark(image, read_image(options.dark, flip=flip))
    if options.is_mosaic:
        image = grey_of_mosaic(image)
    if options.mask is not None:
        image = without_dead_zones(image, read_image(options.mask, flip=flip))
    return image


def identify_frames(
    matcher: Matcher,
    measured: MeasuredFile,
    camera: Camera,
    observer: Observer | None = None,
    fov_error: float | None = None,
    near: Near | None = None,
    fov_deg: tuple[float, float] | None = None,
) -> list[MatchResult]:
    """Identify the frames of a file."""
    if measured.image is not None:
        height, width = measured.image.shape
        if (width, height) != (camera.width_px, camera.height_px):
            raise ConfigError(
                f"the image has {width} x {height} px, the camera {camera.width_px} x "
                f"{camera.height_px}; describe the camera that took it with --camera"
            )
    if fov_deg is not None:
        fov_error = 0.0
    if fov_error is None:
        can = matcher.method in SCALE_FREE and matcher.database.image is None
        fov_error = FOV_ERROR_OF_IMAGES if measured.image is not None and can else 0.0
    asked = _asked(matcher, near, fov_deg)
    identify = partial(asked, camera=camera, fov_error=fov_error)
    if observer is None:
        return [identify(frame.centroids_px, magnitudes=frame.mag) for frame in measured.frames]
    if isinstance(near, Tracker):
        raise ConfigError("--track does not tell planets from stars; leave out --time, or --track")
    from starcat.sky.spots import identify_in_time

    return [
        identify_in_time(
            identify,
            matcher.database,
            frame.centroids_px,
            camera,
            observer,
            magnitudes=frame.mag,
            tolerance_px=matcher.tolerance_px,
            max_false_match_probability=matcher.max_false_match_probability,
        )
        for frame in measured.frames
    ]


def _asked(
    matcher: Matcher, near: Near | None, fov_deg: tuple[float, float] | None
) -> Callable[..., MatchResult]:
    """Return what identifies frames where they are expected."""
    if near is None:
        return partial(matcher.identify, fov_deg=fov_deg)
    if fov_deg is not None:
        raise ConfigError(
            "--fov is for frames of an unknown camera; leave out --track and --prior-q"
        )
    if isinstance(near, Tracker):
        return near.identify
    return partial(matcher.identify, prior=near[0], prior_error_deg=near[1])


def write_simulated(path: Path, frame: Frame, camera: Camera, seed: int) -> None:
    """Write a simulated frame as centroids, or as the image that a camera would take."""
    from starcat.images.image_file import WRITTEN_KINDS, write_image

    suffix = path.suffix.lower()
    if suffix == CENTROIDS_SUFFIX:
        write_centroids(frame.centroids_px, path, frame.mag)
        return
    if suffix not in WRITTEN_KINDS:
        raise ConfigError(
            f"{path}: the name says no kind of frame that starcat writes; end it with one of "
            f"{CENTROIDS_SUFFIX} (centroids), {', '.join(WRITTEN_KINDS)} (images)"
        )

    from starcat.images.render import Optics, render_image
    from starcat.images.scene import Scene, in_file_steps

    eight_bits = Scene(bits=8, black_adu=90.0, adu_per_step=4.0)  # of the default optics
    size = camera.width_px, camera.height_px
    image = render_image(frame.centroids_px, frame.mag, size, Optics(), seed)
    if WRITTEN_KINDS[suffix] == "JPEG":
        image = in_file_steps(image, eight_bits)
    write_image(path, image)


def draw(
    path: Path,
    measured: MeasuredFile,
    result: MatchResult,
    database: Database,
    camera: Camera,
    sky: SkyInTime | None = None,
) -> None:
    """Draw the first frame of a file with its stars circled and named."""
    from starcat.images.overlay import overlay_from_attitude
    from starcat.images.picture import compass_from_matrix, draw_identified

    frame = measured.frames[0]
    title, below = f"{frame.name}: {result.status.replace('_', ' ')}", database.name
    compass = overlay = None
    if result.status == "identified":
        title = (
            f"{frame.name}: RA {result.boresight_ra_deg:.4f}, "
            f"Dec {result.boresight_dec_deg:+.4f}, roll {result.roll_deg:.3f} deg"
        )
        below = (
            f"{result.n_matched} of {len(result.star_index)} spots are stars of {database.name}, "
            f"residual {result.residual_arcsec:.1f} arcsec"
        )
        matrix = matrix_from_quaternion(result.q_body_from_icrs)
        compass = compass_from_matrix(matrix)
        bodies = () if sky is None else sky.bodies
        overlay = overlay_from_attitude(matrix, camera, database.epoch_jyear, bodies)
    draw_identified(
        path,
        measured.image,
        (camera.width_px, camera.height_px),
        frame.centroids_px,
        _labels(result, database, sky),
        title,
        mag=frame.mag,
        below=below,
        compass=compass,
        overlay=overlay,
    )


def _labels(result: MatchResult, database: Database, sky: SkyInTime | None) -> list[str | None]:
    """Return the names that stars are known by; the catalog's own where there is no other.

    The spot of a planet has an empty name: it is identified, and named beside its place.
    """
    from starcat.sky.names import common_names

    rows = np.flatnonzero(result.star_index >= 0)
    stars = result.star_index[rows]
    own = [name.decode() for name in database.designation[stars].tolist()]
    known = common_names(own, database.directions[stars], database.mag[stars], database.epoch_jyear)
    labels: list[str | None] = [None] * len(result.star_index)
    for row, name, other in zip(rows.tolist(), known, own, strict=True):
        labels[row] = name or short_name(other)
    for body in () if sky is None else sky.bodies:
        if body.row is not None:
            labels[body.row] = ""
    return labels


def short_name(designation: str) -> str:
    """Return a designation that fits beside a star.

    Examples
    --------
    >>> short_name("Gaia DR3 3221269181884277504"), short_name("SAO 308")
    ('Gaia …84277504', 'SAO 308')
    """
    words = designation.split() or [""]
    if len(words[-1]) <= 12:
        return designation
    return f"{words[0]} …{words[-1][-8:]}"
