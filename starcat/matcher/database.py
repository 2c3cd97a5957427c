"""The products of an artifact as the matcher holds them: arrays, read from its HDF5 file."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from starcat.camera import Camera
from starcat.errors import ProductError, SchemaVersionError
from starcat.kvector import KVector

READABLE_LAYOUT = 1
"""Major version of the HDF5 layout that this matcher reads."""


@dataclass(frozen=True)
class PairIndex:
    """Star pairs by separation.

    Attributes
    ----------
    i, j : ndarray of int32, shape (M,)
        Rows of the stars.
    kvector : KVector
        Over the separations, radians.
    """

    i: NDArray[np.int32]
    j: NDArray[np.int32]
    kvector: KVector


@dataclass(frozen=True)
class Database:
    """What a matcher needs of an artifact.

    Attributes
    ----------
    name : str
        ``<name>-<version>``.
    camera : Camera
        The camera that the database was built for.
    epoch_jyear : float
        Of the directions.
    star_id : ndarray of int64, shape (N,)
        Permanent star numbers.
    directions : ndarray of float64, shape (N, 3)
        ICRS unit vectors.
    mag : ndarray of float64, shape (N,)
        Magnitudes.
    designation : ndarray of bytes, shape (N,)
        Names.
    pairs : PairIndex
        Of the product ``pairs``.
    """

    name: str
    camera: Camera
    epoch_jyear: float
    star_id: NDArray[np.int64]
    directions: NDArray[np.float64]
    mag: NDArray[np.float64]
    designation: NDArray[np.bytes_]
    pairs: PairIndex


def open_database(artifact: Path) -> Database:
    """Open the database of an artifact.

    Parameters
    ----------
    artifact : Path
        The artifact's folder, or its ``database.h5``.

    Returns
    -------
    Database
        With its arrays in memory.

    Raises
    ------
    ProductError
        If there is no database, or it lacks a product.
    SchemaVersionError
        If its layout is of another major version.
    """
    path = artifact / "database.h5" if artifact.is_dir() else artifact
    if not path.is_file():
        raise ProductError(f"{path}: no such database; give the folder of an artifact", path=path)
    try:
        with h5py.File(path, "r") as file:
            return _read(file, path)
    except (OSError, KeyError, ValueError, RuntimeError) as error:
        raise ProductError(
            f"{path}: not a readable starcat database ({error}); build it again", path=path
        ) from error


def _read(file: h5py.File, path: Path) -> Database:
    layout = str(file.attrs["layout_version"])
    if int(layout.split(".")[0]) != READABLE_LAYOUT:
        raise SchemaVersionError(
            f"{path}: layout version {layout}; this matcher reads {READABLE_LAYOUT}.x",
            product="database",
            found=layout,
            expected=f"{READABLE_LAYOUT}.x",
        )
    stars, pairs = file["stars"], file["pairs"]
    camera = json.loads(file.attrs["camera"])
    kvector = KVector(
        pairs["separation_rad"][:],
        pairs["kvector_counts"][:],
        float(pairs.attrs["kvector_intercept"]),
        float(pairs.attrs["kvector_slope"]),
    )
    return Database(
        name=f"{file.attrs['name']}-{file.attrs['version']}",
        camera=Camera(camera["width_px"], camera["height_px"], camera["focal_length_px"]),
        epoch_jyear=float(file.attrs["epoch_jyear"]),
        star_id=stars["star_id"][:],
        directions=np.stack([stars[axis][:] for axis in ("x", "y", "z")], axis=-1),
        mag=stars["mag"][:],
        designation=stars["designation"][:],
        pairs=PairIndex(pairs["i"][:], pairs["j"][:], kvector),
    )
