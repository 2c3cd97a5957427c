"""The catalogs that a service offers, and estimates of specs from them.

Reading takes seconds, so catalogs stay in memory. The guide stars of the last specs do too, so that
a slider that does not change them is answered at once. `starcat_service.estimates` limits how many
requests come at the same time.
"""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar

import numpy as np
import pyarrow.compute as pc
from cachetools import LRUCache
from pydantic import BaseModel, Field

from starcat.catalog import data_source, locate, star_sources
from starcat.errors import SourceMissing
from starcat.pipeline import (
    MAX_FIELD_STARS,
    Draft,
    Estimate,
    Starter,
    choose_stars,
    enough_limit,
    estimate_draft,
    read_draft,
    reading_keys,
    starter_spec,
)
from starcat.pipeline.specs import BuildSpec, CameraSpec, preset, preset_names
from starcat.storage import json_bytes
from starcat.version import __version__
from starcat_service.jobs.keys import source_files
from starcat_service.problems import Problem

T = TypeVar("T")

READ_BYTES, CHOICE_BYTES, ESTIMATE_BYTES = 640 << 20, 128 << 20, 64 << 20
"""Memory for catalogs that were read, for guide stars, and for estimates."""

MAX_INPUT_BYTES = 2 << 30
"""Larger files are read for an estimate only down to ``catalog.read_limit_mag``."""

AT_ONCE = 2
"""Estimates that are made at the same time."""


@dataclass(frozen=True)
class CatalogRead:
    """A catalog that was read for an estimate."""

    source: Annotated[str, Field(exclude=True)]
    band: Annotated[str, Field(description="Of the magnitudes.", examples=["G"])]
    epoch_jyear: Annotated[float, Field(description="Julian year that the stars were moved to.")]
    stars: Annotated[int, Field(description="Stars that can be chosen from.")]
    brightest_mag: Annotated[float | None, Field(description="Of the stars with a magnitude.")]
    faintest_mag: Annotated[float | None, Field(description="Of the stars with a magnitude.")]


class Offered(BaseModel):
    """A catalog that a spec may name."""

    name: str = Field(description="For ``catalog.source``.", examples=["gaia"])
    title: str = Field(examples=["The Hipparcos Catalogue, main file"])
    is_here: bool = Field(description="Whether its files are, so that a build can read it.")
    bands: tuple[str, ...] = Field(
        description="For ``catalog.band``, the default first.", examples=[["V", "Hp"]]
    )
    epoch_jyear: float | None = Field(
        None, description="Epoch of the positions in its files, if all have the same."
    )
    frame: str = Field(description="Axes of the positions in its files.", examples=["ICRS"])
    records: int | None = Field(None, description="Records of the whole archive.")
    citation: str = Field(description="How to cite it.")
    licence: str = Field(description="Terms of its use.")
    read: tuple[CatalogRead, ...] = Field(description="Figures known from earlier estimates.")
    hint: str | None = Field(None, description="What to do if it is not on this machine.")


class Catalogs:
    """The catalogs of a service, and estimates from them."""

    def __init__(self, max_memory_bytes: int | None = None) -> None:
        self._max_memory_bytes = max_memory_bytes
        # Drafts that were read; a draft larger than the limit is kept alone.
        self._read: LRUCache[str, tuple[Draft, CatalogRead]] = LRUCache(
            READ_BYTES, lambda pair: min(_bytes_of(pair[0]), READ_BYTES)
        )
        self._choices: LRUCache[Any, Draft] = LRUCache(CHOICE_BYTES, _chosen_bytes)
        self._estimates: LRUCache[Any, Estimate] = LRUCache(
            ESTIMATE_BYTES, lambda estimate: estimate.fields.nbytes
        )
        self._limits: LRUCache[Any, tuple[float, float]] = LRUCache(1000)
        self._estimating = threading.Semaphore(AT_ONCE)
        self._lock = threading.RLock()
        self._underway: dict[str, Future[Draft]] = {}
        # One at a time: a catalog takes memory.
        self._reader = ThreadPoolExecutor(1, "catalog-reader")

    def catalogs_read(self) -> list[CatalogRead]:
        """Return the figures of the catalogs that were read."""
        with self._lock:
            return [catalog for _, catalog in self._read.values()]

    def estimate(self, spec: BuildSpec) -> Estimate:
        """Estimate the result of a spec."""
        key = self._key(spec)
        whole = (key, spec.model_dump_json())
        estimate = self._cached(self._estimates, whole)
        if estimate is None:
            read = self.read(spec, key)
            with self._estimating:
                choice = self._choice(read, key, spec)
                estimate = estimate_draft(read, choice, spec, self._max_memory_bytes)
            self._cache(self._estimates, whole, estimate)
        return estimate

    def starter(
        self,
        name: str,
        camera: CameraSpec,
        faint_limit_mag: float | None = None,
        widest_fov_x_deg: float | None = None,
        reach_mag: float | None = None,
    ) -> Starter:
        """Return a first spec for a camera, from the embedded sky, as `starter_spec`."""
        # The default preset reads the data that a first spec is made from.
        sky = self.read(preset(preset_names()[0])).stars
        with self._estimating:
            return starter_spec(
                name,
                camera,
                faint_limit_mag,
                widest_fov_x_deg=widest_fov_x_deg,
                sky=sky,
                most_field_stars=MAX_FIELD_STARS,
                reach_mag=-np.inf if reach_mag is None else reach_mag,
            )

    def enough_limit(self, spec: BuildSpec) -> tuple[float, float]:
        """Return the faint limit that a camera needs, and the magnitude where the catalog ends."""
        key = self._key(spec)
        part = (key, "limit", spec.camera.model_dump_json(), spec.boresights.model_dump_json())
        limits = self._cached(self._limits, part)
        if limits is None:
            read = self.read(spec, key)
            with self._estimating:
                deepest = pc.max(read.stars["mag"]).as_py()
                limits = enough_limit(read.stars, spec), np.inf if deepest is None else deepest
            self._cache(self._limits, part, limits)
        return limits

    def read(self, spec: BuildSpec, key: str | None = None) -> Draft:
        """Return the catalogs of a spec; read them if they have not been read yet."""
        key = self._key(spec) if key is None else key
        cached = self._cached(self._read, key)
        if cached is not None:
            return cached[0]
        _check_size(spec)
        with self._lock:
            future = self._underway.get(key)
            if future is None:
                future = self._reader.submit(self._read_files, key, spec)
                self._underway[key] = future
                future.add_done_callback(lambda _: self._forget(key))
        return future.result()

    def close(self) -> None:
        """Start no more reading; a read in progress is not waited for."""
        self._reader.shutdown(wait=False, cancel_futures=True)

    def _forget(self, key: str) -> None:
        with self._lock:
            self._underway.pop(key, None)

    def _read_files(self, key: str, spec: BuildSpec) -> Draft:
        draft = read_draft(spec, {})
        self._cache(self._read, key, (draft, _facts(spec, draft)))
        return draft

    def _cached(self, cache: LRUCache[Any, T], key: Any) -> T | None:
        with self._lock:
            return cache.get(key)

    def _cache(self, cache: LRUCache[Any, T], key: Any, value: T) -> None:
        with self._lock, suppress(ValueError):  # larger than the cache
            cache[key] = value

    def _choice(self, read: Draft, key: str, spec: BuildSpec) -> Draft:
        content = spec.model_dump(mode="json")
        sections = {name: content[name] for name in ("selection", "camera", "boresights")}
        sections["products"] = {
            name: content["products"][name]
            for name, section in spec.products.requested.items()
            if section.has_own_fields
        }
        part = (key, json_bytes(sections))
        choice = self._cached(self._choices, part)
        if choice is None:
            choice = choose_stars(read, spec)
            self._cache(self._choices, part, choice)
        return choice

    @staticmethod
    def _key(spec: BuildSpec) -> str:
        """Return the key under which the catalogs of a spec are kept: requested data and files."""
        files = {name: _stamps(name) for name in sources_read(spec)}
        content = {"starcat": __version__, "asked": reading_keys(spec), "files": files}
        return hashlib.sha256(json_bytes(content)).hexdigest()[:32]


def offered_catalogs(catalogs_read: Sequence[CatalogRead]) -> list[Offered]:
    """Return the catalogs that a spec can name; ``catalogs_read`` are those read for estimates."""
    offered = []
    for name in star_sources():
        if data_source(name).table is not None and not is_here(name):
            continue  # list only tables on this machine: there are too many others
        read = tuple(catalog for catalog in catalogs_read if catalog.source == name)
        offered.append(_offered(name, read))
    return sorted(offered, key=lambda catalog: not catalog.is_here)


def is_here(name: str) -> bool:
    """Return whether the files of a source are on this machine."""
    try:
        return bool(locate(name, {}))
    except SourceMissing:
        return False


def _offered(name: str, read: tuple[CatalogRead, ...]) -> Offered:
    source, is_found = data_source(name), is_here(name)
    hint = (
        f"the operator can get it with 'starcat fetch {name}', or set $STARCAT_CATALOGS to the "
        "folder that has its files"
    )
    return Offered(
        name=name,
        title=source.title,
        is_here=is_found,
        bands=source.bands,
        epoch_jyear=source.epoch_jyear,
        frame=source.frame,
        records=source.rows,
        citation=source.citation,
        licence=source.licence,
        read=read,
        hint=None if is_found else hint,
    )


def _check_size(spec: BuildSpec) -> None:
    for name in sources_read(spec):
        limit = spec.catalog.read_limit_mag
        key = "catalog.read_limit_mag"
        if name in spec.catalog.motions:
            limit = spec.products.crossmatch.read_limit_mag
            key = "products.crossmatch.read_limit_mag"
        size = sum(stamp[1] for stamp in _stamps(name))
        if limit is None and size > MAX_INPUT_BYTES:
            raise Problem(
                413,
                f"{name}: its files have {size / 1e9:,.1f} GB, more than an estimate reads whole; "
                f"give {key}, and fainter records are only counted",
                key=key,
            )


def sources_read(spec: BuildSpec) -> tuple[str, ...]:
    """Return the sources that an estimate reads, without counterparts."""
    names = (*spec.catalog.catalogs, *spec.catalog.motions, *spec.joins)
    return tuple(dict.fromkeys(names))


def _stamps(name: str) -> list[tuple[str, int, int]]:
    stamps = []
    for path in source_files(name, locate(name, {})):
        stat = path.stat()
        stamps.append((str(path), stat.st_size, stat.st_mtime_ns))
    return stamps


def _bytes_of(read: Draft) -> int:
    """Return the memory that a draft takes."""
    return int(read.stars.nbytes + (0 if read.motions is None else read.motions.nbytes))


def _chosen_bytes(choice: Draft) -> int:
    """Return the memory that the guide stars of a draft and their fields take."""
    tables = choice.selected.guide_stars, choice.selected.rejected
    steps = (step.directions for step in choice.selected.steps)
    return int(choice.fields.nbytes + sum(each.nbytes for each in (*tables, *steps)))


def _facts(spec: BuildSpec, read: Draft) -> CatalogRead:
    mags = pc.min_max(read.stars["mag"]).as_py()
    band = spec.catalog.band or data_source(spec.catalog.source).bands[0]
    return CatalogRead(
        spec.catalog.source, band, spec.middle_jyear, len(read.stars), mags["min"], mags["max"]
    )
