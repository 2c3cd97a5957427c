"""Facts of a database on pages: from its manifest and from the report of its build."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from starcat.catalog.stars import Reason
from starcat.database import MANIFEST_NAME
from starcat.errors import ProductError, reason
from starcat.pipeline.selection import ALL_REASONS
from starcat.pipeline.simulation import rates_of
from starcat.results import to_dict
from starcat.ship.releases import recorded
from starcat.storage import product_schema
from starcat_service.api.databases import REPORT
from starcat_service.library import ListedDatabase
from starcat_service.service import Service

NOT_LISTED = (Reason.beyond_read_limit.name,)
"""Reasons whose records are counted but not in the product ``rejected``."""

_ROWS = """\
SELECT designation, mag, band, ra_deg, dec_deg, reason, amplitude_mag, star_id
FROM rejected
WHERE reason = '{}'
ORDER BY mag, star_id"""

MAX_JOBS = 1000  # most jobs that are searched for the time of a build


@dataclass(frozen=True)
class FactRow:
    """A database in the form that lists and heads of pages show."""

    database: ListedDatabase
    rates: list[Mapping[str, Any]]  # rates of the self-test, the clean frames first
    is_released: bool  # whether this exact content is in the registry
    built_s: float  # seconds since 1970


def database_rows(service: Service, *databases: ListedDatabase) -> list[FactRow]:
    """Return databases in the form of the list: these, or all."""
    released = {
        release.title: release.manifest.sha256 for release in recorded(service.paths.registry)
    }
    built: dict[str, float] = {}
    for job in service.jobs.all(state="done", most=MAX_JOBS):
        database_id = (job.result or {}).get("database")
        if job.kind == "build" and database_id and job.ended_s:
            built[str(database_id)] = job.ended_s
    return [
        FactRow(
            database,
            _rates(database),
            database.title in released
            and released[database.title] == database.manifest_blob.sha256,
            built.get(database.id) or (database.folder / MANIFEST_NAME).stat().st_mtime,
        )
        for database in databases or service.library.databases()
    ]


def _rates(database: ListedDatabase) -> list[Mapping[str, Any]]:
    """Return the rates of the self-test."""
    # A report of an older version has no share of all pointings.
    return [to_dict(rates_of(rates)) for rates in readable_report(database).get("self_test", ())]


def readable_report(database: ListedDatabase) -> dict[str, Any]:
    """Return the report of a build, empty if it is damaged: it does not hide other databases."""
    try:
        return report_of(database)
    except ProductError:
        return {}


def products_of(manifest: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the products of a manifest, each with its schema and the size of its file."""
    return [
        {
            **facts,
            "name": name,
            "schema": product_schema(*facts["schema"].rsplit("-", 1)),
            "bytes": manifest["files"][facts["parquet"]]["bytes"],
            "in_database": facts.get("in_database", False),
        }
        for name, facts in manifest["products"].items()
    ]


def star_fact_columns(manifest: Mapping[str, Any]) -> list[str]:
    """Return the columns of ``stars`` with errors and blends that the database has."""
    spec = manifest["spec"]
    schema = product_schema(*manifest["products"]["stars"]["schema"].rsplit("-", 1))
    names = ["mag_error", "position_error_end_arcsec"]
    if not isinstance(spec["epoch_jyear"], int | float):
        names.append("drift_arcsec")
    if spec["selection"].get("neighbours"):
        names += ["centroid_offset_arcsec", "contamination", "blend_mag"]
    columns = {column.name for column in schema.columns}
    return [name for name in names if name in columns]


def rejections_of(manifest: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return why records of the catalogs are not guide stars, the most frequent reason first.

    Each reason has its number of records, its meaning, and a query for its rows; None if the
    records are not listed.
    """
    counts: Counter[str] = Counter()
    for source in manifest["sources"]:
        if source["role"] == "stars":
            counts.update(source["rejected"])
    words = ALL_REASONS
    return [
        {
            "name": name.replace("_", " "),
            "records": count,
            "meaning": words.get(name, ""),
            "query": None if name in NOT_LISTED or name not in words else _ROWS.format(name),
        }
        for name, count in sorted(counts.items(), key=lambda entry: (-entry[1], entry[0]))
        if count
    ]


def report_of(database: ListedDatabase) -> dict[str, Any]:
    """Return the report of a build."""
    path = database.folder / REPORT
    if REPORT not in database.manifest["files"]:
        return {}
    try:
        return _read_json(path, path.stat().st_mtime_ns)
    except (OSError, ValueError) as error:
        words = reason(error) if isinstance(error, OSError) else str(error)
        raise ProductError(
            f"{path.name}: the report of {database.title} cannot be read ({words})",
            path=path,
            hint="build the database again",
        ) from error


@lru_cache(maxsize=64)
def _read_json(path: Path, changed_ns: int) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(path.read_bytes())
    return content
