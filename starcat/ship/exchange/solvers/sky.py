"""The input of every solver: the guide stars, the fields of view, and their origin."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from starcat.arrays import Array
from starcat.catalog.stars.star_table import directions_of, floats_of
from starcat.database.manifest import MANIFEST_NAME
from starcat.database.reader import DatabaseFolder
from starcat.geometry.camera import Camera
from starcat.geometry.sphere import radec_from_directions
from starcat.pipeline.specs.reading import spec_of_database
from starcat.storage.atomic import file_sha256
from starcat.version import __version__


@dataclass(frozen=True)
class SolverSky:
    """The guide stars of a database, brightest first, at its epoch; rows are stars."""

    name: str  # <name>-<version>
    source: str
    epoch_jyear: float
    star_id: NDArray[np.int64]
    designation: tuple[str, ...]
    directions: Array  # ICRS unit vectors, shape (N, 3)
    ra_deg: Array
    dec_deg: Array
    mag: Array
    camera: Camera
    fov_deg: tuple[float, float]  # narrowest and widest field of view, horizontal
    manifest_sha256: str

    @property
    def provenance(self) -> dict[str, Any]:
        """The origin of a solver's file."""
        return {
            "database": self.name,
            "manifest_sha256": self.manifest_sha256,
            "starcat": __version__,
            "source": self.source,
            "epoch_jyear": self.epoch_jyear,
            "stars": len(self.mag),
            "faintest_mag": float(self.mag[-1]),
            "fov_deg": [round(fov, 9) for fov in self.fov_deg],
        }


def sky_of(database: DatabaseFolder) -> SolverSky:
    """Return the input for a solver's file."""
    manifest, spec = database.manifest, spec_of_database(database)
    stars = database.stars
    order = np.lexsort((stars["star_id"].to_numpy(), floats_of(stars, "mag")))
    stars = stars.take(pa.array(order))
    directions = directions_of(stars)
    ra_deg, dec_deg = radec_from_directions(directions)
    return SolverSky(
        name=f"{manifest['name']}-{manifest['version']}",
        source=spec.catalog.source,
        epoch_jyear=float(manifest["epoch_jyear"]),
        star_id=stars["star_id"].to_numpy(),
        designation=tuple(text or "" for text in stars["designation"].to_pylist()),
        directions=directions,
        ra_deg=ra_deg,
        dec_deg=dec_deg,
        mag=floats_of(stars, "mag"),
        camera=spec.camera.camera(),
        fov_deg=spec.fields_deg,
        manifest_sha256=file_sha256(database.folder / MANIFEST_NAME),
    )
