"""What pages say of a database: read from its manifest and from the report of its build."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from starcat.errors import ProductError, reason
from starcat.releases.publishing import recorded
from starcat.service.jobs.job import Job
from starcat.service.library import Database
from starcat.service.paths import ServicePaths
from starcat.service.service import Service
from starcat.specs.build_spec import CameraSpec
from starcat.storage.schema import product_schema

REPORT = "report/report.json"

MANIFEST_DIGEST = "manifest_sha256"
"""Key of a manifest with the digest of all the others."""

MAX_JOBS = 1000
"""Jobs that are looked through for the time of a build."""


@dataclass(frozen=True)
class Row:
    """A database as the list shows it.

    Attributes
    ----------
    id, title, name, version, description : str
        Which it is.
    catalog : str
        Name of the star catalog, with the band.
    camera : str
        Pixels and field of view, in words.
    stars, bytes : int
        Guide stars, and the size of all files.
    rates : list of mapping
        Shares of the self-test, the clean frames first; empty without a report.
    is_released : bool
        Whether exactly this is in the registry.
    built_s : float
        Seconds since 1970.
    """

    id: str
    title: str
    name: str
    version: str
    description: str
    catalog: str
    camera: str
    stars: int
    bytes: int
    rates: list[Mapping[str, Any]]
    is_released: bool
    built_s: float


@dataclass(frozen=True)
class Product:
    """A product of a database.

    Attributes
    ----------
    name, schema, description, parquet : str
        Its name, the version of its schema, what a row is and what else is stored, its file.
    rows, bytes : int
        Records, and the size of the Parquet file.
    in_database : bool
        Whether the matcher's file has it too.
    columns : list of (str, str, str, str)
        Name, type, unit and meaning of each column.
    """

    name: str
    schema: str
    description: str
    parquet: str
    rows: int
    bytes: int
    in_database: bool
    columns: list[tuple[str, str, str, str]]

    @property
    def summary(self) -> str:
        """What a row is."""
        return re.split(r"[.:;] ", self.description)[0].rstrip(".")


def database_rows(service: Service) -> list[Row]:
    """Return all databases as the list shows them."""
    released = released_digests(service.paths)
    built = built_times(service.jobs.all(state="done", most=MAX_JOBS))
    return [_row(one, released, built) for one in service.library.databases()]


def database_row(service: Service, database: Database) -> Row:
    """Return one database as the list shows it."""
    built = built_times(service.jobs.all(state="done", most=MAX_JOBS))
    return _row(database, released_digests(service.paths), built)


def released_digests(paths: ServicePaths) -> dict[str, str]:
    """Return what was published."""
    return {release.title: release.manifest.sha256 for release in recorded(paths.registry)}


def built_times(jobs: Iterable[Job]) -> dict[str, float]:
    """Return when databases were built."""
    times: dict[str, float] = {}
    for job in jobs:
        made = (job.result or {}).get("database")
        if job.kind == "build" and made and job.ended_s:
            times[str(made)] = job.ended_s
    return times


def _row(one: Database, released: Mapping[str, str], built: Mapping[str, float]) -> Row:
    manifest = one.manifest
    spec = manifest["spec"]
    band = spec["catalog"].get("band")
    itself = one.folder / "manifest.json"
    return Row(
        id=one.id,
        title=one.title,
        name=one.name,
        version=one.version,
        description=str(spec.get("description") or ""),
        catalog=f"{spec['catalog']['source']}{f' ({band})' if band else ''}",
        camera=CameraSpec.model_validate(spec["camera"]).camera().in_words,
        stars=int(manifest["products"]["stars"]["rows"]),
        bytes=total_bytes(manifest),
        rates=_rates(one),
        is_released=one.title in released and released[one.title] == one.manifest_blob.sha256,
        built_s=built.get(one.id) or itself.stat().st_mtime,
    )


def _rates(database: Database) -> list[Mapping[str, Any]]:
    """Return the rates of the self-test: a damaged report does not hide other databases."""
    try:
        return list(report_of(database).get("self_test", ()))
    except ProductError:
        return []


def total_bytes(manifest: Mapping[str, Any]) -> int:
    """Return the size of all files of an artifact, without its manifest."""
    return sum(int(facts["bytes"]) for facts in manifest["files"].values())


def products_of(manifest: Mapping[str, Any]) -> list[Product]:
    """Return the products of a database."""
    found = []
    for name, facts in manifest["products"].items():
        product, _, version = str(facts["schema"]).rpartition("-")
        schema = product_schema(product, version)
        found.append(
            Product(
                name=name,
                schema=facts["schema"],
                description=schema.description,
                parquet=facts["parquet"],
                rows=int(facts["rows"]),
                bytes=int(manifest["files"][facts["parquet"]]["bytes"]),
                in_database=bool(facts.get("in_database")),
                columns=[(c.name, c.dtype, c.unit, c.description) for c in schema.columns],
            )
        )
    return found


def report_of(database: Database) -> dict[str, Any]:
    """Return the report of a build."""
    path = database.folder / REPORT
    if REPORT not in database.manifest["files"]:
        return {}
    try:
        return _read_json(path, path.stat().st_mtime_ns)
    except (OSError, ValueError) as error:
        words = reason(error) if isinstance(error, OSError) else str(error)
        raise ProductError(
            f"{path.name}: the report of {database.title} cannot be read ({words}); build the "
            "database again",
            path=path,
        ) from error


@lru_cache(maxsize=64)
def _read_json(path: Path, changed_ns: int) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(path.read_bytes())
    return content
