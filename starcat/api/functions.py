"""Building, reading catalogs and verifying, from Python.

Each function here turns strings into paths, fills in what is usual, and calls the one function
of the rooms that the command line calls too.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from starcat.resources import PathLike

if TYPE_CHECKING:  # a program that only matches has none of the libraries behind these
    from starcat.artifact.verify import Verification
    from starcat.calibration.calibrate import Calibration
    from starcat.catalog.ingest import Ingested
    from starcat.geometry.camera import Camera
    from starcat.pipeline.build import Built
    from starcat.progress import Progress
    from starcat.specs.build_spec import BuildSpec


def build(
    spec: BuildSpec | PathLike,
    output: PathLike = "dist",
    *,
    inputs: Mapping[str, PathLike | Sequence[PathLike]] | None = None,
    replace: bool = False,
    workers: int = 2,
    progress: Progress | None = None,
) -> Built:
    """Build a guide-star database, check it, and prove that it identifies its own fields.

    Parameters
    ----------
    spec : BuildSpec, str or path-like
        A spec, or the TOML file of one.
    output : str or path-like, default "dist"
        Folder that the folder ``<name>-<version>`` is made in.
    inputs : mapping of str to path or paths, optional
        Files or folders by source; what is not named is looked for, as the command line does.
    replace : bool, default False
        Whether a different artifact of the same name and version may be replaced.
    workers : int, default 2
        Threads; the artifact is the same for any number.
    progress : callable, optional
        Called with (stage, done, total).

    Returns
    -------
    Built
        The folder and what is worth telling about it.

    Raises
    ------
    ConfigError, SourceError, BuildError, OutputError
        As the command line says them.
    """
    from starcat.pipeline.build import build as run
    from starcat.progress import no_progress
    from starcat.specs.build_spec import BuildSpec
    from starcat.specs.reading import read_spec

    chosen = spec if isinstance(spec, BuildSpec) else read_spec(spec)
    given = {source: _paths(files) for source, files in (inputs or {}).items()}
    return run(
        chosen,
        given,
        Path(output),
        replace=replace,
        workers=workers,
        progress=progress or no_progress,
    )


def ingest(
    source: str,
    inputs: PathLike | Sequence[PathLike] | None = None,
    *,
    band: str | None = None,
    epoch_jyear: float | None = None,
    read_limit_mag: float | None = None,
    progress: Progress | None = None,
) -> Ingested:
    """Read a catalog into a star table, with a reason for every record left out.

    Parameters
    ----------
    source : str
        Such as ``sao``; ``starcat sources`` lists them.
    inputs : path or sequence of paths, optional
        Its files or folder; looked for by default, as the command line does.
    band : str, optional
        Band of the magnitudes; the source's first by default.
    epoch_jyear : float, optional
        Julian year to move positions to; the catalog's own by default.
    read_limit_mag : float, optional
        Fainter records are counted and not held: ``beyond_read_limit`` of what is returned.
    progress : callable, optional
        Called with (stage, done, total).

    Returns
    -------
    Ingested
        Star table, rejected rows and what was read.

    Raises
    ------
    ConfigError, SourceError
        If the source is unknown, or its files are missing or damaged.
    """
    from starcat.catalog.source_files import locate
    from starcat.progress import no_progress
    from starcat.store.reading import read_catalog as read

    return read(
        source,
        locate(source, {source: _paths(inputs)} if inputs is not None else {}),
        band=band,
        epoch_jyear=epoch_jyear,
        read_limit_mag=read_limit_mag,
        progress=progress or no_progress,
    )


def calibrate(
    artifact: PathLike,
    frames: PathLike | Sequence[PathLike],
    *,
    camera: Camera | None = None,
    size_px: tuple[int, int] | None = None,
    fov_deg: tuple[float, float] | None = None,
    method: str | None = None,
    flip: bool | None = None,
    progress: Progress | None = None,
) -> Calibration:
    """Find focal length, principal point and distortion of a camera from frames of stars.

    Parameters
    ----------
    artifact : str or path-like
        The folder ``<name>-<version>`` of a database for about this field.
    frames : path or sequence of paths
        Images or files of centroids, of one camera.
    camera : Camera, optional
        To start from; the database's own by default.
    size_px : tuple of int, optional
        Width and height, where there is no camera; those of the images by default.
    fov_deg : tuple of float, optional
        Smallest and largest field across the width, degrees; by default that of the camera, with
        a focal length that may be wrong by a tenth.
    method : str, optional
        A way to identify; the best that the artifact's products allow by default.
    flip : bool, optional
        Whether the first row of an image is its bottom; the file's own word by default.
    progress : callable, optional
        Called with (stage, done, total).

    Returns
    -------
    Calibration
        With ``camera``, the errors and covariance of what was fitted, and the comparison of
        models on frames that were left out.

    Raises
    ------
    ConfigError, ProductError
        If a file cannot be read, or what is known of the camera contradicts itself.
    CalibrationError
        If too few frames can be identified; says which and why.
    """
    from starcat.calibration.files import calibrate_files
    from starcat.matcher.matcher import Matcher
    from starcat.progress import no_progress

    return calibrate_files(
        Matcher.open(artifact, method),
        _paths(frames),
        camera=camera,
        size_px=size_px,
        fov_deg=fov_deg,
        flip=flip,
        progress=progress or no_progress,
    )


def verify(artifact: PathLike) -> Verification:
    """Check an artifact: digests, schemas, rows, orders, indices, references, counts.

    Parameters
    ----------
    artifact : str or path-like
        The folder ``<name>-<version>``.

    Returns
    -------
    Verification
        With its findings; none where all is well.

    Raises
    ------
    ProductError
        If the folder is not an artifact.
    """
    from starcat.artifact.verify import verify_artifact

    return verify_artifact(Path(artifact))


def _paths(given: PathLike | Sequence[PathLike]) -> list[Path]:
    one = isinstance(given, str | os.PathLike)
    return [Path(given)] if one else [Path(path) for path in given]  # type: ignore[arg-type, union-attr]
