"""From files to answers and back: frames in files, what the matcher says of them, pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from starcat.errors import ConfigError
from starcat.geometry.attitude import matrix_from_quaternion
from starcat.geometry.camera import Camera
from starcat.matcher.centroids import MeasuredFrame, read_frames, write_centroids
from starcat.matcher.database import Database
from starcat.matcher.matcher import Matcher
from starcat.matcher.result import MatchResult
from starcat.matcher.tracking import Tracker
from starcat.simulation.simulate import Frame

IMAGE_SUFFIXES = (".fits", ".fit", ".fts", ".gz", ".fz", ".png", ".tif", ".tiff")
"""Files that are read as images; all others hold centroids."""

PriorOption = tuple[list[float], float]
"""An attitude as a quaternion, and its largest error in degrees."""

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


def measure(path: Path, *, flip: bool | None = None) -> MeasuredFile:
    """Read centroids, or find them in an image.

    Parameters
    ----------
    path : Path
        CSV, JSON, FITS, PNG or TIFF.
    flip : bool, optional
        Whether the first row of an image is its bottom; the file's own word by default.

    Returns
    -------
    MeasuredFile
        One frame for CSV and images.

    Raises
    ------
    ConfigError
        If the file cannot be read, or images cannot be for lack of a package.
    """
    if path.suffix.lower() not in IMAGE_SUFFIXES:
        return MeasuredFile(read_frames(path))
    from starcat.images.centroiding import find_spots
    from starcat.images.image_file import read_image

    image = read_image(path, flip=flip)
    spots = find_spots(image)
    return MeasuredFile([MeasuredFrame(path.stem, spots.centroids_px, spots.mag)], image)


def identify_frames(
    matcher: Matcher | Tracker,
    measured: MeasuredFile,
    camera: Camera,
    prior: PriorOption | None = None,
) -> list[MatchResult]:
    """Identify the frames of a file.

    Parameters
    ----------
    matcher : Matcher or Tracker
        The matcher, with a database open, or what follows the frames with it.
    measured : MeasuredFile
        The frames.
    camera : Camera
        That took them.
    prior : (list of float, float), optional
        Attitude of all frames, ``q_body_from_icrs``, and its largest error in degrees.

    Returns
    -------
    list of MatchResult
        One a frame.

    Raises
    ------
    ConfigError
        If the image is not of the camera's size.
    """
    if measured.image is not None:
        height, width = measured.image.shape
        if (width, height) != (camera.width_px, camera.height_px):
            raise ConfigError(
                f"the image has {width} x {height} px, the camera {camera.width_px} x "
                f"{camera.height_px}; describe the camera that took it with --camera"
            )
    q, error_deg = prior or (None, None)
    return [
        matcher.identify(
            frame.centroids_px, camera, magnitudes=frame.mag, prior=q, prior_error_deg=error_deg
        )
        for frame in measured.frames
    ]


def write_simulated(path: Path, frame: Frame, camera: Camera, seed: int) -> None:
    """Write a simulated frame as centroids, or as the image that a camera would take.

    Parameters
    ----------
    path : Path
        CSV, FITS, PNG or TIFF.
    frame : Frame
        Centroids and magnitudes.
    camera : Camera
        The camera, for its size.
    seed : int
        Seed of the image's noise.

    Raises
    ------
    ConfigError
        If the suffix says neither centroids nor a kind of image that is written.
    OutputError
        If the file cannot be written.
    """
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

    size = camera.width_px, camera.height_px
    write_image(path, render_image(frame.centroids_px, frame.mag, size, Optics(), seed))


def draw(
    path: Path, measured: MeasuredFile, result: MatchResult, database: Database, camera: Camera
) -> None:
    """Draw the first frame of a file with its stars circled and named.

    Parameters
    ----------
    path : Path
        PNG or SVG file to write.
    measured : MeasuredFile
        The frames.
    result : MatchResult
        The answer to the first one.
    database : Database
        Names of the stars.
    camera : Camera
        The camera, for its size.

    Raises
    ------
    ConfigError
        If the picture is of another kind.
    OutputError
        If it cannot be written.
    """
    from starcat.images.picture import compass_from_matrix, draw_identified

    frame = measured.frames[0]
    names = [
        short_name(database.designation[row].decode()) if row >= 0 else None
        for row in result.star_index
    ]
    title, below, compass = f"{frame.name}: {result.status.replace('_', ' ')}", database.name, None
    if result.status == "identified":
        title = (
            f"{frame.name}: RA {result.boresight_ra_deg:.4f}, "
            f"Dec {result.boresight_dec_deg:+.4f}, roll {result.roll_deg:.3f} deg"
        )
        below = (
            f"{result.n_matched} of {len(names)} spots are stars of {database.name}, "
            f"residual {result.residual_arcsec:.1f} arcsec"
        )
        compass = compass_from_matrix(matrix_from_quaternion(result.q_body_from_icrs))
    draw_identified(
        path,
        measured.image,
        (camera.width_px, camera.height_px),
        frame.centroids_px,
        names,
        title,
        mag=frame.mag,
        below=below,
        compass=compass,
    )


def short_name(designation: str) -> str:
    """Return a designation that fits beside a star.

    Parameters
    ----------
    designation : str
        Catalog and number.

    Returns
    -------
    str
        Long numbers keep their last eight digits: of six, Gaia's have 15,625 endings only.

    Examples
    --------
    >>> short_name("Gaia DR3 3221269181884277504"), short_name("SAO 308")
    ('Gaia …84277504', 'SAO 308')
    """
    words = designation.split()
    if len(words[-1]) <= 12:
        return designation
    return f"{words[0]} …{words[-1][-8:]}"
