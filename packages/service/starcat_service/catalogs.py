"""The catalogs that a service offers, and estimates of specs from them.

Reading takes seconds, so catalogs stay in memory. So do the guide stars of the last specs, and a
slider that does not change them is answered at once.
"""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from cachetools import LRUCache

from starcat.catalog.parts import CATALOGS
from starcat.catalog.source import DataSource, data_source, star_sources
from starcat.catalog.source_files import locate
from starcat.errors import SourceMissing
from starcat.pipeline.catalog_snapshot import CatalogSnapshot, read_snapshot, reading_keys
from starcat.pipeline.estimate import Choice, Estimate, choose_stars, estimate
from starcat.pipeline.guide_stars import MOST_FIELD_STARS
from starcat.pipeline.starter import Starter, enough_limit, starter_spec
from starcat.specs.build_spec import BuildSpec, CameraSpec
from starcat.specs.reading import preset, preset_names
from starcat.storage.digests import json_bytes
from starcat.version import __version__
from starcat_service.jobs.keys import source_files
from starcat_service.problems import Problem

T = TypeVar("T")

WAIT_S = 25.0
"""Seconds that a request waits for a catalog to be read, or for a free slot."""

RETRY_S = 5
"""Seconds after which to ask again."""

READ_BYTES, CHOICE_BYTES, ESTIMATE_BYTES = 640 << 20, 128 << 20, 64 << 20
"""Memory for catalogs that were read, for guide stars, and for estimates."""

MOST_INPUT_BYTES = 2 << 30
"""Larger files are read for an estimate only down to ``catalog.read_limit_mag``."""

MOST_WAITING = 8
"""Catalogs that wait to be read; more are refused."""

AT_ONCE = 2
"""Estimates that are made at the same time."""


@dataclass(frozen=True)
class CatalogRead:
    """What is known of a catalog that was read."""

    source: str
    band: str
    epoch_jyear: float  # its stars were moved to this Julian year
    stars: int  # that can be chosen from
    brightest_mag: float | None  # of the stars that have a magnitude
    faintest_mag: float | None


@dataclass(frozen=True)
class Offered:
    """A catalog that a spec may name."""

    source: DataSource  # what it is
    is_here: bool  # whether its files are
    read: tuple[CatalogRead, ...]  # what is known of it where it was read


class Catalogs:
    """The catalogs of a service, and estimates from them."""

    def __init__(self, max_memory_bytes: int | None = None, wait_s: float = WAIT_S) -> None:
        self._max_memory_bytes = max_memory_bytes
        self._wait_s = wait_s
        # Pairs of CatalogSnapshot and CatalogRead; one that is larger than the limit is alone.
        self._read: LRUCache[str, tuple[CatalogSnapshot, CatalogRead]] = LRUCache(
            READ_BYTES, lambda pair: min(pair[0].nbytes, READ_BYTES)
        )
        self._choices: LRUCache[Any, Choice] = LRUCache(CHOICE_BYTES, lambda choice: choice.nbytes)
        self._estimates: LRUCache[Any, Estimate] = LRUCache(
            ESTIMATE_BYTES, lambda found: found.fields.nbytes
        )
        self._limits: LRUCache[Any, tuple[float, float]] = LRUCache(1000)
        self._slots = threading.Semaphore(AT_ONCE)
        self._lock = threading.RLock()
        self._underway: dict[str, Future[CatalogSnapshot]] = {}
        # One at a time: a catalog takes memory.
        self._reader = ThreadPoolExecutor(1, "catalog-reader")

    def offered(self) -> list[Offered]:
        """Return the catalogs that a spec may name."""
        known, found = self.known(), []
        for name in (*CATALOGS, *filter(is_here, set(star_sources()) - set(CATALOGS))):
            read = tuple(one for one in known if one.source == name)
            found.append(Offered(data_source(name), is_here(name), read))
        return sorted(found, key=lambda one: not one.is_here)

    def known(self) -> list[CatalogRead]:
        """Return what is known of the catalogs that were read."""
        with self._lock:
            return [catalog for _, catalog in self._read.values()]

    def estimate(self, spec: BuildSpec) -> Estimate:
        """Estimate what a spec will give."""
        key = self._key(spec)
        whole = (key, spec.model_dump_json())
        found = self._cached(self._estimates, whole)
        if found is None:
            read = self.read(spec, key)
            with self._slot():
                choice = self._choice(read, key, spec)
                found = estimate(read, choice, spec, self._max_memory_bytes)
            self._cache(self._estimates, whole, found)
        return found

    def starter(
        self,
        name: str,
        camera: CameraSpec,
        faint_limit_mag: float | None = None,
        widest_fov_x_deg: float | None = None,
    ) -> Starter:
        """Return a first spec for a camera, from the embedded sky."""
        # The default preset reads what a first spec is made from.
        sky = self.read(preset(preset_names()[0])).stars
        with self._slot():
            return starter_spec(
                name,
                camera,
                faint_limit_mag,
                widest_fov_x_deg=widest_fov_x_deg,
                sky=sky,
                most_field_stars=MOST_FIELD_STARS,
            )

    def enough_limit(self, spec: BuildSpec) -> tuple[float, float]:
        """Return the faint limit that a camera needs, and the magnitude where the catalog ends."""
        key = self._key(spec)
        part = (key, "limit", spec.camera.model_dump_json(), spec.boresights.model_dump_json())
        found = self._cached(self._limits, part)
        if found is None:
            read = self.read(spec, key)
            with self._slot():
                deepest = read.magnitudes[1] if read.magnitudes else np.inf
                found = enough_limit(read.stars, spec), deepest
            self._cache(self._limits, part, found)
        return found

    def read(self, spec: BuildSpec, key: str | None = None) -> CatalogSnapshot:
        """Return the catalogs of a spec; read them where that was not done yet."""
        key = self._key(spec) if key is None else key
        found = self._cached(self._read, key)
        if found is not None:
            return found[0]
        _check_size(spec)
        with self._lock:
            future = self._underway.get(key)
            if future is None:
                if len(self._underway) >= MOST_WAITING:
                    raise _busy("too many catalogs wait to be read", RETRY_S)
                future = self._reader.submit(self._read_files, key, spec)
                self._underway[key] = future
                future.add_done_callback(lambda _: self._forget(key))
        try:
            return future.result(self._wait_s)
        except TimeoutError:
            if future.done():
                raise
            names = ", ".join(_sources_read(spec))
            raise _busy(
                f"{names}: being read, which takes longer than a request waits", RETRY_S
            ) from None

    def close(self) -> None:
        """Begin no more reading; what is underway is not waited for."""
        self._reader.shutdown(wait=False, cancel_futures=True)

    def _forget(self, key: str) -> None:
        with self._lock:
            self._underway.pop(key, None)

    def _read_files(self, key: str, spec: BuildSpec) -> CatalogSnapshot:
        found = read_snapshot(spec, {})
        self._cache(self._read, key, (found, _facts(spec, found)))
        return found

    def _cached(self, cache: LRUCache[Any, T], key: Any) -> T | None:
        with self._lock:
            return cache.get(key)

    def _cache(self, cache: LRUCache[Any, T], key: Any, value: T) -> None:
        with self._lock, suppress(ValueError):  # larger than the cache
            cache[key] = value

    def _choice(self, read: CatalogSnapshot, key: str, spec: BuildSpec) -> Choice:
        content = spec.model_dump(mode="json")
        own = {name: content[name] for name in ("selection", "camera", "boresights")}
        own["products"] = {
            name: content["products"][name]
            for name, section in spec.products.wanted.items()
            if section.has_own_fields
        }
        part = (key, json_bytes(own))
        found = self._cached(self._choices, part)
        if found is None:
            found = choose_stars(read, spec)
            self._cache(self._choices, part, found)
        return found

    @contextmanager
    def _slot(self) -> Iterator[None]:
        if not self._slots.acquire(timeout=self._wait_s):
            raise _busy("too many estimates are being made", 1)
        try:
            yield
        finally:
            self._slots.release()

    @staticmethod
    def _key(spec: BuildSpec) -> str:
        """Return what the catalogs of a spec are kept under: what was asked for, of which files."""
        files = {name: _stamps(name) for name in _sources_read(spec)}
        content = {"starcat": __version__, "asked": reading_keys(spec), "files": files}
        return hashlib.sha256(json_bytes(content)).hexdigest()[:32]


def _busy(what: str, again_s: int) -> Problem:
    headers = {"Retry-After": str(again_s)}
    return Problem(503, f"{what}; ask again in {again_s} s", headers=headers)


def is_here(name: str) -> bool:
    """Return whether the files of a source are here."""
    try:
        return bool(locate(name, {}))
    except SourceMissing:
        return False


def _check_size(spec: BuildSpec) -> None:
    for name in _sources_read(spec):
        limit = spec.catalog.read_limit_mag
        key = "catalog.read_limit_mag"
        if name in spec.catalog.motions:
            limit = spec.products.crossmatch.read_limit_mag
            key = "products.crossmatch.read_limit_mag"
        size = sum(stamp[1] for stamp in _stamps(name))
        if limit is None and size > MOST_INPUT_BYTES:
            raise Problem(
                413,
                f"{name}: its files have {size / 1e9:,.1f} GB, more than an estimate reads whole; "
                f"give {key}, and fainter records are only counted",
                key=key,
            )


def _sources_read(spec: BuildSpec) -> tuple[str, ...]:
    """Return the sources that an estimate reads: counterparts are none of them."""
    names = (*spec.catalog.catalogs, *spec.catalog.motions, *spec.joins)
    return tuple(dict.fromkeys(names))


def _stamps(name: str) -> list[tuple[str, int, int]]:
    found = []
    for path in source_files(name, locate(name, {})):
        stat = path.stat()
        found.append((str(path), stat.st_size, stat.st_mtime_ns))
    return found


def _facts(spec: BuildSpec, read: CatalogSnapshot) -> CatalogRead:
    mags = read.magnitudes
    band = spec.catalog.band or data_source(spec.catalog.source).bands[0]
    return CatalogRead(
        spec.catalog.source,
        band,
        spec.middle_jyear,
        len(read.stars),
        mags and mags[0],
        mags and mags[1],
    )
