"""Data for the view of the sky: stars of a part of it, and the field of a camera."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
from fastapi import Query
from fastapi.responses import JSONResponse, Response

from starcat.catalog import data_source
from starcat.errors import ConfigError
from starcat.frames.sky import common_names
from starcat.geometry import Camera, directions_from_radec, radec_from_directions, separation
from starcat_service.access import Reader
from starcat_service.api.sql import SqlQuery, result_table
from starcat_service.library import ListedDatabase
from starcat_service.pages.rendering import page_router
from starcat_service.service import Service, TheService

router = page_router()

MOST = 1500  # stars of a kind in a view
EDGE_POINTS = 12  # points of an outline on each edge
CACHED = {"Cache-Control": "private, max-age=86400"}
"""Content that never changes under its address: a database's id identifies its content."""

SIMBAD = "https://simbad.cds.unistra.fr/simbad/sim-id"
VIZIER = "https://vizier.cds.unistra.fr/viz-bin/VizieR"
_CDS = re.compile(r"CDS ([IVXB]+/\w+)")

_PART = """(SELECT '{kind}' AS kind, {reason} AS reason, star_id, designation, mag, ra_deg, dec_deg
FROM {rows} WHERE mag IS NOT NULL AND ra_deg IS NOT NULL AND {condition}
ORDER BY mag, star_id LIMIT {most})"""
_KINDS = (
    ("guide", "stars", "NULL", "true"),
    ("rejected", "rejected", "reason", "reason <> 'too_faint'"),
    ("faint", "rejected", "reason", "reason = 'too_faint'"),
)
"""Kind of a star, its product, the SQL of its reason, and the condition on its rows."""


@dataclass(frozen=True)
class SkyStar:
    """A star in the view of the sky."""

    label: str  # designation
    ra_deg: float
    dec_deg: float
    mag: float | None
    id: str | None = None  # its ``star_id``
    name: str | None = None  # its common name
    reason: str | None = None  # reason of the rejection or of the mark, in words
    kind: str = "mark"  # or the first of a row of `_KINDS`

    def as_dict(self) -> dict[str, Any]:
        """Return its known facts in the form that the script reads."""
        return {name: value for name, value in vars(self).items() if value is not None}


def in_words(reason: object) -> str | None:
    """Return a reason without underscores; None if there is none."""
    return None if reason is None else str(reason).replace("_", " ")


@router.get("/databases/{database_id}/sky.json")
async def stars_of_view(
    service: TheService,
    _: Reader,
    database_id: str,
    ra: Annotated[float, Query(ge=0, le=360)] = 0.0,
    dec: Annotated[float, Query(ge=-90, le=90)] = 0.0,
    radius: Annotated[float, Query(gt=0, le=180)] = 180.0,
    faint: bool = False,
) -> Response:
    """Return the brightest stars of a part of the sky; rejected stars have their reason."""
    stars = await service.query_pool.run(
        _stars, service, service.library.database(database_id), (ra, dec, radius), faint
    )
    return JSONResponse({"stars": [star.as_dict() for star in stars]}, headers=CACHED)


def _stars(
    service: Service, database: ListedDatabase, where: tuple[float, float, float], faint: bool
) -> list[SkyStar]:
    is_all = where[2] >= 90.0
    parts = [
        _PART.format(
            kind=kind,
            reason=reason,
            rows=table if is_all else f"cone($ra, $dec, $radius, of := '{table}')",
            condition=condition,
            most=MOST,
        )
        for kind, table, reason, condition in _KINDS
        if table in database.products and (faint or kind != "faint")
    ]
    values = {} if is_all else dict(zip(("ra", "dec", "radius"), where, strict=True))
    query = SqlQuery(
        [database.id],
        "\nUNION ALL\n".join(parts) + "\nORDER BY kind, mag, star_id",
        values,
        len(_KINDS) * MOST,
        service.settings.query_time_s,
    )
    answer = result_table(service, query).with_json_values()
    names = [column.name for column in answer.columns]
    stars = [_star(dict(zip(names, row, strict=True))) for row in answer.rows]
    return _named(stars, float(database.manifest["epoch_jyear"]))


def _star(row: Mapping[str, Any]) -> SkyStar:
    return SkyStar(
        label=row["designation"] or f"star {row['star_id']}",
        ra_deg=round(row["ra_deg"], 6),
        dec_deg=round(row["dec_deg"], 6),
        mag=round(row["mag"], 4),
        id=str(row["star_id"]),
        reason=in_words(row["reason"]),
        kind=row["kind"],
    )


def _cds_catalog(source: str) -> str:
    """Return the CDS number of a catalog; empty if it has none."""
    if source == "gaia":  # the embedded sky is an excerpt of it
        return "I/355/gaiadr3"
    try:
        match = _CDS.search(data_source(source).identifier)
    except ConfigError:
        return ""
    return match[1] if match else ""


NAMED_TO_MAG = 8.5  # stars fainter than this have no name of their own


def _named(stars: list[SkyStar], epoch_jyear: float) -> list[SkyStar]:
    bright = [star for star in stars if star.mag is not None and star.mag <= NAMED_TO_MAG]
    names = star_names_of([vars(star) for star in bright], epoch_jyear)
    names_by_id = {star.id: name for star, name in zip(bright, names, strict=True)}
    return [replace(star, name=names_by_id.get(star.id)) for star in stars]


def star_names_of(stars: Sequence[Mapping[str, Any]], epoch_jyear: float) -> list[str | None]:
    """Return the common names of stars; None for a star that has only a designation."""
    if not stars:
        return []
    ra, dec, mag = (
        np.array([star[name] for star in stars], dtype=np.float64)
        for name in ("ra_deg", "dec_deg", "mag")
    )
    labels = [str(star["label"]) for star in stars]
    names = common_names(labels, directions_from_radec(ra, dec), mag, epoch_jyear)
    return [None if name == label else name for name, label in zip(names, labels, strict=True)]


def outline_of(camera: Camera) -> list[list[float]]:
    """Return directions along the edge of a detector in the camera frame, once around."""
    w, h, part = camera.width_px, camera.height_px, np.arange(EDGE_POINTS) / EDGE_POINTS
    x = np.concatenate([part * w, np.full(EDGE_POINTS, w), w - part * w, np.zeros(EDGE_POINTS)])
    y = np.concatenate([np.zeros(EDGE_POINTS), part * h, np.full(EDGE_POINTS, h), h - part * h])
    edge = camera.directions_from_pixels(np.stack([x, y], axis=1))
    return [[round(value, 8) for value in row] for row in edge.tolist()]


def sky_view(
    database: ListedDatabase,
    camera: Camera | None = None,
    marks: Sequence[SkyStar] = (),
    **more: Any,
) -> dict[str, Any]:
    """Return the data for the script of the view: addresses, a camera's field, marked stars."""
    view_camera, address = camera or database.camera, f"/databases/{database.id}"
    return {
        "stars": f"{address}/sky.json",
        "sql": f"{address}/sql",
        "simbad": SIMBAD,
        "vizier": VIZIER,
        "catalog": _cds_catalog(str(database.spec["catalog"]["source"])),
        "outline": outline_of(view_camera),
        "fov": [view_camera.fov_x_deg, view_camera.fov_y_deg],
        "marks": [mark.as_dict() for mark in marks],
        **more,
    }


def around(positions: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Return a view that contains some positions: its centre, and its angle across, degrees."""
    ra, dec = (
        np.array([position[name] for position in positions]) for name in ("ra_deg", "dec_deg")
    )
    directions = directions_from_radec(ra, dec)
    middle = directions.sum(axis=0)
    length = float(np.sqrt(middle @ middle))
    if length < 0.3 * len(positions):  # all over the sky
        return {"ra": 0.0, "dec": 0.0, "size": 360.0}
    middle /= length
    reach = float(np.degrees(separation(directions, middle).max()))
    ra_deg, dec_deg = radec_from_directions(middle)
    size = 360.0 if reach > 60.0 else max(3.0 * reach, 1.0)
    return {"ra": round(float(ra_deg), 4), "dec": round(float(dec_deg), 4), "size": size}
