"""The C library that flies (``onboard/``), called with an onboard image.

It is compiled when a wheel is built. If it is missing or cannot take a frame, the numpy matcher
is used, with the same rules and the same stars.
"""

from __future__ import annotations

import math
import mmap
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from importlib import import_module
from struct import Struct
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcat.arguments import FLOAT64
from starcat.arrays import Array
from starcat.database.onboard.layout import FEATURES, METHODS
from starcat.errors import ProductError
from starcat.geometry.camera import Camera
from starcat.matcher.batch import BatchResult
from starcat.matcher.database import MatcherDatabase
from starcat.matcher.methods.votes import has_few_neighbours
from starcat.matcher.observation import Dropped, Frame, Frames
from starcat.matcher.pose import focal_length_error_px
from starcat.matcher.prior import Prior
from starcat.matcher.refusal import Reason, Refusal, stated_facts
from starcat.matcher.result import IDS_AT, MATRIX_AT, SHAPE_AT, MatchResult, Status, no_match
from starcat.matcher.search_tables import search_tables
from starcat.matcher.settings import Settings
from starcat.matcher.shape import N_TERMS, Shape
from starcat.matcher.star_density import with_few_stars
from starcat.matcher.stars import ARCSEC

try:
    _onboard: Any = import_module("starcat.matcher._onboard")
except ImportError:  # the wheel was built without a compiler
    _onboard = None


MAX_STEPS = 300_000_000
"""Steps of the library for one frame: about a second. They are smaller than the numpy steps."""

SKIP_CRC = 1
"""``STARCAT_SKIP_CRC`` of ``starcat.h``: whoever reads an image has compared its checksums."""

CHUNK = 256
"""Number of frames that one thread takes at a time."""

STATUSES: dict[int, Status] = {
    0: "identified", 1: "no_match", 2: "too_few_stars", -14: "no_match",
}  # fmt: skip
"""Result of a frame, by the number that the library returns: -14 if the steps are used up."""

REASONS: tuple[Reason, ...] = (
    "chance", "too_few_stars", "no_candidate", "chance", "share_of_frame", "scale", "steps",
)  # fmt: skip
"""Why there is no answer, by the number of the library."""

NOT_OPENED = {
    -4: "it is of a version of the format that the library does not read",
    -5: "it was written for the other byte order",
    -9: "a field of it has more stars than the library has room for",
}
"""Why an image that starcat can read is not opened, by the number that the library returns."""

DROPPED = {-2: "not_finite", -3: "out_of_frame", -4: "duplicate"}
"""Why a centroid was not used, by the number that the library gives it."""


def is_compiled() -> bool:
    """Return whether the C library is there."""
    return _onboard is not None


def library_version() -> str | None:
    """Return the version of the C library."""
    if _onboard is None:
        return None
    return str(_onboard.ffi.string(_onboard.lib.starcat_version()).decode())


_NUMBERS = Struct("@4iq6d")
"""The numbers that ``starcat_frame_answer`` of ``many.h`` begins with; its arrays follow."""

_COUNT = Struct("@q")

_IDENTIFIED, _INCOMPLETE = 0, 3

_INT32 = np.dtype(np.int32)

_OF_CANDIDATE = -16
"""``STARCAT_OF_CANDIDATE`` of ``many.h``: this minus the row of the star of a candidate."""


@lru_cache(maxsize=1)
def _answer_dtype() -> np.dtype[np.void]:
    """Return the record of numpy that is ``starcat_frame_answer`` of ``many.h``, byte by byte."""
    struct = _onboard.ffi.typeof("starcat_frame_answer")
    fields = dict(struct.fields)
    return np.dtype(
        {
            "names": list(fields),
            "formats": [_dtype(field.type) for field in fields.values()],
            "offsets": [field.offset for field in fields.values()],
            "itemsize": _onboard.ffi.sizeof(struct),
        }
    )


def _dtype(ctype: Any) -> np.dtype[Any]:
    if ctype.kind == "array":
        return np.dtype((_dtype(ctype.item), (ctype.length,)))
    name: str = ctype.cname
    return np.dtype("float64" if name == "double" else name.removesuffix("_t"))


@dataclass(frozen=True)
class _Batch:
    """The output of the library for many frames of one camera."""

    # One ``starcat_frame_answer`` per frame, by its names in ``many.h``; attitudes are zeros unless
    # it is identified or has a candidate.
    records: NDArray[np.void]
    # Row of the database; -1 without a star; a key of `DROPPED` if the centroid was not used;
    # `_OF_CANDIDATE` minus the row of the star of a candidate.
    star_index: NDArray[np.int32]
    star_ids: NDArray[np.int64]
    frames: Frames
    search: Search

    @cached_property
    def codes(self) -> list[int]:
        """Return the result number of each frame."""
        codes: list[int] = self.records["status"].tolist()
        return codes

    def result(self) -> BatchResult:
        """Return the batch as Python objects; a frame that the library refused is a no_match."""
        records = self.records
        has_attitude = records["status"][:, None] == _onboard.lib.STARCAT_IDENTIFIED
        attitudes = np.where(has_attitude, records["q_body_from_icrs"], np.nan)
        status = [STATUSES.get(code, "no_match") for code in self.codes]
        return BatchResult(status, records["seconds"].copy(), attitudes, self._answer)

    def _answer(self, frame: int) -> MatchResult:
        rows = slice(self.frames.starts[frame], self.frames.starts[frame + 1])
        parts = self.records[frame], self.star_ids[rows], self.star_index[rows]
        record = bytearray(b"".join(part.tobytes() for part in parts))
        return self.search.answer(record, self.frames[frame])


def _dropped(star: NDArray[np.int32]) -> Dropped:
    """Return row and reason of every centroid that was not used, repeats last."""
    rows = np.flatnonzero((star < -1) & (star > _OF_CANDIDATE))
    reasons = [(int(row), DROPPED[int(star[row])]) for row in rows]
    return tuple(sorted(reasons, key=lambda item: item[1] == "duplicate"))


class CEngine:
    """An onboard image in memory, and the C library that reads it."""

    def __init__(
        self,
        database: MatcherDatabase,
        data: bytes | mmap.mmap,
        rows: NDArray[np.int64] | None = None,
    ) -> None:
        ffi, lib = _onboard.ffi, _onboard.lib
        self._words, self.image = _aligned(data), ffi.new("starcat_image *")
        status = lib.starcat_open_image(
            self.image, ffi.from_buffer(self._words), len(data), SKIP_CRC
        )
        if status != lib.STARCAT_OK:
            raise ProductError(
                f"an onboard image of {len(data):,} bytes is not opened by the C library: "
                f"{NOT_OPENED.get(status, f'error {status}')}",
                hint="export the database for this machine",
            )
        star_rows = np.arange(int(self.image.n_stars)) if rows is None else rows
        self._listing, self._neighbours = Lock(), (ffi.NULL,)
        if has_few_neighbours(database):  # an empty table until a frame needs votes
            self._neighbours = (ffi.new("starcat_neighbours *"),)
        self.image.neighbours = self._neighbours[0]
        self.rows = ffi.from_buffer("int32_t[]", star_rows.astype(np.int32))
        self.database = database

    def search(self, camera: Camera, settings: Settings, fov_error: float = 0.0) -> Search:
        """Return the search of the library for frames of a camera."""
        return Search(self, camera, settings, fov_error)

    def list_neighbours(self) -> None:
        """List the neighbours of the stars, once: the library needs them for votes.

        They take most of the time of opening a large database, and most frames do without votes.
        """
        with self._listing:
            if self.image.neighbours and not self.image.neighbours.neighbour:
                empty = self._neighbours  # other threads may read it
                self._neighbours = *_neighbours(self.image, self.database), empty
                self.image.neighbours = self._neighbours[0]


def _aligned(data: bytes | mmap.mmap) -> NDArray[np.uint8]:
    """Return bytes in memory that begins at a multiple of 16, as the library needs it."""
    view = np.frombuffer(data, dtype=np.uint8)
    if view.ctypes.data % 16 == 0:
        return view
    words = np.zeros(-(-len(data) // 8), dtype=np.uint64)
    copy = words.view(np.uint8)[: len(data)]
    copy[:] = view
    return copy


def _neighbours(image: Any, database: MatcherDatabase) -> tuple[Any, ...]:
    """Return the neighbours of an image's stars, for votes, and the memory they are in."""
    ffi, lib = _onboard.ffi, _onboard.lib
    count, radius_rad = int(image.n_stars), database.camera.radius_rad
    first = ffi.new("uint32_t[]", count + 1)
    # Room for twice the neighbours of an even sky; for all of them if these are more.
    capacity = count + int(2.0 * (count * math.sin(0.5 * radius_rad)) ** 2)
    for _ in range(2):
        kept = ffi.new("starcat_neighbour[]", capacity)
        table = ffi.new("starcat_neighbours *", [radius_rad, capacity, 0, first, kept])
        if lib.starcat_list_all_neighbours(image, table) == lib.STARCAT_OK:
            return table, first, kept
        capacity = max(1, first[count])
    return (ffi.NULL,)


class Search:
    """The C library with an image, a camera and settings; threads may share it."""

    def __init__(
        self, engine: CEngine, camera: Camera, settings: Settings, fov_error: float
    ) -> None:
        self.camera, self._settings, self._fov_error = camera, settings, fov_error
        self._noise_px = settings.noise_px
        self._database = engine.database
        # The library is given addresses: the objects at these addresses have to be kept.
        self._engine = engine
        self._kept = engine, _camera(camera), _options(settings, fov_error)
        addresses = [engine.image, *self._kept[1:], engine.rows]
        self._address = _onboard.ffi.new("starcat_search *", addresses)
        self._one, self._null = _onboard.lib.starcat_identify_one, _onboard.ffi.NULL
        self._most = int(_onboard.lib.STARCAT_MAX_CENTROIDS)

    def identify(self, frame: Frame, prior: Prior | None = None) -> MatchResult | None:
        """Identify the stars of a frame; None if the library does not take it.

        The overhead of a call is the copying of arrays to the library and back, as bytes.
        """
        count = len(frame.centroids_px)
        if count > self._most:
            return None
        px = frame.centroids_px.tobytes()
        mags = None if frame.mag is None else frame.mag.tobytes()
        sigma = None if frame.sigma_px is None else frame.sigma_px.tobytes()
        memory = _FREE.pop() if _FREE else _Memory()
        arguments = (
            self._address,
            count,
            px,
            self._null if mags is None else mags,
            self._null if sigma is None else sigma,
            self._null if prior is None else prior.q_body_from_icrs.tobytes(),
            0.0 if prior is None else prior.error_rad,
            memory.address,
        )
        code = self._one(*arguments)
        if code == _INCOMPLETE:
            self._engine.list_neighbours()
            code = self._one(*arguments)
        record = bytearray(memory.answer[: IDS_AT + 12 * count])
        _FREE.append(memory)
        if code not in STATUSES:
            return None
        kept = Frame(
            np.ndarray((count, 2), FLOAT64, px),
            None if mags is None else np.ndarray(count, FLOAT64, mags),
            self.camera,
            None if sigma is None else np.ndarray(count, FLOAT64, sigma),
        )
        return self.answer(record, kept, prior)

    def identify_many(self, frames: Frames, threads: int = 1) -> tuple[BatchResult, list[int]]:
        """Identify the stars of frames; return the answers, and the frames without an answer.

        The library refuses these frames: a camera or a number is beyond its limits.
        """
        count, starts = len(frames), frames.starts
        records, star_index = np.zeros(count, _answer_dtype()), np.full(starts[-1], -1, np.int32)
        star_ids = np.full(starts[-1], -1, np.int64)
        ffi = _onboard.ffi
        arrays = (
            ffi.from_buffer("int64_t[]", starts),
            _double_pointer(frames.centroids_px),
            _double_pointer(frames.mag),
            _double_pointer(frames.sigma_px),
            ffi.from_buffer("starcat_frame_answer[]", records),
            ffi.from_buffer("int32_t[]", star_index),
            ffi.from_buffer("int64_t[]", star_ids),
        )

        def run(first: int) -> None:
            memory = _FREE.pop() if _FREE else _Memory()
            stop = min(first + CHUNK, count)
            arguments = self._address, first, stop, *arrays, memory.address
            _onboard.lib.starcat_identify_many(*arguments)
            if _INCOMPLETE in records["status"][first:stop]:
                self._engine.list_neighbours()
                _onboard.lib.starcat_identify_many(*arguments)
            _FREE.append(memory)

        parts = range(0, count, CHUNK)
        if threads <= 1 or len(parts) <= 1:
            for part in parts:
                run(part)
        else:
            with ThreadPoolExecutor(min(threads, os.cpu_count() or 1)) as pool:
                list(pool.map(run, parts))
        batch = _Batch(records, star_index, star_ids, frames, self)
        return batch.result(), [n for n, code in enumerate(batch.codes) if code not in STATUSES]

    def answer(self, record: bytearray, frame: Frame, prior: Prior | None = None) -> MatchResult:
        """Return the answer that the library has written.

        ``record`` is a ``starcat_frame_answer`` of ``many.h``, the numbers of the stars and their
        rows. Arrays of the answer are views of it.
        """
        (
            code, reason, n_matched, n_usable, _, time_s,
            chance, share, focal_length_px, residual_arcsec, chi_square,
        ) = _NUMBERS.unpack_from(record)  # fmt: skip
        count = len(frame.centroids_px)
        star_index = np.ndarray(count, _INT32, record, IDS_AT + 8 * count)
        content: dict[str, Any] = {"status": "identified", "star_index": star_index}
        content["matrix"] = np.ndarray((3, 3), FLOAT64, record, MATRIX_AT)
        content["reduced_chi_square"] = chi_square
        content["residual_arcsec"] = residual_arcsec
        content["false_match_probability"] = chance
        content["camera"] = frame.camera
        content["time_s"] = time_s
        content["frame"] = frame
        content["database"] = self._database
        content["noise_px"] = self._noise_px
        content["otherwise_px"] = self._settings.assumed_noise_px
        content["fov_error"] = self._fov_error
        if prior is not None:
            content["origin"] = "tracking"
        if n_usable < count:
            content["dropped"] = _dropped(star_index)
        if code == _IDENTIFIED:
            content["_record"] = record
            if n_usable < count:
                np.maximum(star_index, -1, out=star_index)
        elif focal_length_px:
            content["star_index"] = np.maximum(_OF_CANDIDATE - star_index, -1)
        (n_shape,) = _COUNT.unpack_from(record, SHAPE_AT + 8 * N_TERMS)
        if n_shape:
            content["shape"] = Shape(np.ndarray(N_TERMS, FLOAT64, record, SHAPE_AT), n_shape)
            content["camera"] = frame.camera.with_focal_length(focal_length_px)
        elif self._fov_error and focal_length_px:
            camera = content["camera"] = frame.camera.with_focal_length(focal_length_px)
            content["focal_length_error_px"] = focal_length_error_px(
                camera.directions_from_pixels(frame.centroids_px[content["star_index"] >= 0]),
                focal_length_px,
                residual_arcsec / ARCSEC,
                self._noise_px,
            )
        if code == _IDENTIFIED:
            identified = MatchResult.of(content)
            return identified.with_facts() if n_shape else identified
        why = _refusal(REASONS[reason], n_matched, chance, share, n_usable, prior)
        why = with_few_stars(why, self._database, frame.camera)
        noises = self._settings.noise_px, self._settings.noise_mag
        inputs = stated_facts(frame.mag is not None, *noises, n_usable < count)
        candidate = MatchResult.of(content) if focal_length_px else None
        facts = ("time_s", "frame", "database", "noise_px", "otherwise_px", "origin", "dropped")
        return no_match(
            count,
            refusal=replace(why, facts=inputs, candidate=candidate),
            **{name: content[name] for name in facts if name in content},
        )


def _refusal(
    reason: Reason, n_matched: int, chance: float, share: float, n_usable: int, prior: Prior | None
) -> Refusal:
    """Return why the library has no answer."""
    if reason == "too_few_stars":
        return Refusal(reason)
    if prior is not None and (reason == "no_candidate" or not chance < 1.0):
        return Refusal("prior")
    if reason == "no_candidate":
        return Refusal(reason)
    return Refusal(reason, n_matched, chance, share, n_usable)


class _Memory:
    """The memory that a call works in, half a megabyte, and views of the results in it."""

    def __init__(self) -> None:
        ffi, most = _onboard.ffi, int(_onboard.lib.STARCAT_MAX_CENTROIDS)
        self.address = ffi.new("starcat_memory *")
        self.answer = ffi.buffer(ffi.addressof(self.address, "answer"), IDS_AT + 12 * most)


_FREE: list[_Memory] = []
"""Memory that no call uses at present. A call takes one from here or makes a new one, so there are
as many as there were calls at the same time; taking and putting back are atomic."""


def _double_pointer(array: Array | None) -> Any:
    """Return the address of numbers, which keeps the array; NULL for None."""
    ffi = _onboard.ffi
    return ffi.NULL if array is None else ffi.from_buffer("double[]", np.ascontiguousarray(array))


@lru_cache(maxsize=16)
def _camera(camera: Camera) -> Any:
    lens = camera.distortion
    return _onboard.ffi.new(
        "starcat_camera *",
        [
            camera.width_px,
            camera.height_px,
            camera.focal_length_px,
            *camera.principal_point_px,
            *(lens.k1, lens.k2, lens.k3, lens.p1, lens.p2),
            0.0 if lens.is_none else lens.fold_radius,
        ],
    )


@lru_cache(maxsize=16)
def _options(settings: Settings, fov_error: float) -> Any:
    chance = math.log(max(settings.max_false_match_probability, 1e-300))
    # The library takes 0 for what is not stated.
    options = {
        "tolerance_px": settings.tolerance_px,
        "noise_px": settings.noise_px or 0.0,
        "noise_mag": settings.noise_mag or 0.0,
        "log_chance": chance,
        "fov_error": fov_error,
        "camera_error": settings.camera_error or 0.0,
        "max_steps": MAX_STEPS,
    }
    return _onboard.ffi.new("starcat_options *", options)


MAX_FEATURES = 4_000_000
"""Largest number of triangles or pairs that ``auto`` makes an image of: three seconds, once."""


def c_engine(database: MatcherDatabase, method: str, always: bool = True) -> CEngine | None:
    """Return the engine of a database, made once; None if the library does not support it.

    Unless ``always`` is set, no image is made of more than `MAX_FEATURES`.
    """
    if _onboard is None or method not in FEATURES:
        return None
    if database.image is not None and database.image.method != method:
        return None
    if not always and database.image is None:
        product, (column, *_) = FEATURES[method]
        if len(database.products[product][column]) > MAX_FEATURES:
            return None
    return database.cached(_open_engine, METHODS.index(method))


def _open_engine(database: MatcherDatabase, method_number: int) -> CEngine | None:
    if database.image is not None:
        return CEngine(database, database.image.data)
    tables = search_tables(database, METHODS[method_number])
    if tables is None or tables.most_near > _onboard.lib.STARCAT_MAX_STARS:
        return None
    return CEngine(database, tables.data, tables.star_rows)
