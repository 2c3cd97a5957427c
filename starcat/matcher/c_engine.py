"""The C library that flies (``onboard/``), called with an onboard image.

It is compiled when a wheel is built. Where it is missing, or cannot take a frame, the matcher of
numpy serves, with the same rules and the same stars.
"""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array
from starcat.errors import ConfigError, ProductError
from starcat.geometry.camera import Camera
from starcat.matcher.database import Database
from starcat.matcher.observation import Frame
from starcat.matcher.prior import Prior
from starcat.matcher.result import Status
from starcat.matcher.settings import Settings
from starcat.onboard.image import Contents, make_image
from starcat.onboard.layout import FEATURES, METHODS

try:
    _onboard: Any = import_module("starcat.matcher._onboard")
except ImportError:  # the wheel was built without a compiler
    _onboard = None


MAX_STEPS = 2_000_000_000
"""Steps for one frame: on the ground the limit is the caller's patience, not a clock."""

CHUNK = 256
"""Frames that one thread takes at a time."""

OUT_OF_STEPS = -14
"""What the library returns where a budget was used up."""

STATUSES: dict[int, Status] = {
    0: "identified", 1: "no_match", 2: "too_few_stars", OUT_OF_STEPS: "no_match",
}  # fmt: skip
"""What a frame came to, by the number that the library returns."""

NOT_OPENED = {
    -4: "it is of a version of the format that the library does not read",
    -5: "it was written for the other byte order",
    -9: "a field of it has more stars than the library has room for",
}
"""Why an image that starcat can read is not opened, by the number that the library returns."""

DROPPED = {-2: "not_finite", -3: "out_of_frame", -4: "duplicate"}
"""Why a centroid was not used, by the number that the library gives it."""


ANSWER = np.dtype(
    [
        ("status", np.int32),
        ("n_matched", np.int32),
        ("steps", np.int64),
        ("q_body_from_icrs", np.float64, 4),
        ("matrix", np.float64, (3, 3)),
        ("residual_rad", np.float64),
        ("log_chance", np.float64),
        ("seconds", np.float64),
    ]
)
"""A frame's answer as the library writes it: a key of `STATUSES`, the attitude, the natural
logarithm of the false-match probability, and the time that the library took."""


@dataclass(frozen=True)
class Answers:
    """What the library found in N frames with K centroids in all."""

    # The centroids of frame n are rows ``starts[n]`` to ``starts[n + 1]``; shape (N + 1,).
    starts: NDArray[np.int64]
    # A record a frame; attitudes are zeros unless it is identified; shape (N,).
    frames: NDArray[np.void]
    # Row of the database; -1 where none; a key of `DROPPED` where the centroid was not used;
    # shape (K,).
    star_index: NDArray[np.int32]

    @property
    def is_whole(self) -> bool:
        """Whether the library took all frames; a camera or limit may be beyond it."""
        return all(code in STATUSES for code in self.frames["status"].tolist())


def is_compiled() -> bool:
    """Return whether the C library is there."""
    return _onboard is not None


def library_version() -> str | None:
    """Return the version of the C library."""
    if _onboard is None:
        return None
    return str(_onboard.ffi.string(_onboard.lib.starcat_version()).decode())


def most_stars() -> int:
    """Return the number of stars in or next to a frame that the C library has room for."""
    return int(_onboard.lib.STARCAT_MAX_STARS)


class CEngine:
    """An onboard image in memory, and the C library that reads it."""

    def __init__(
        self,
        data: bytes,
        rows: NDArray[np.int64] | None = None,
        directions: Array | None = None,
    ) -> None:
        ffi, lib = _onboard.ffi, _onboard.lib
        # Memory of numpy begins at a multiple of 16, as the library wants it; bytes need not.
        words = np.zeros(-(-len(data) // 8), dtype=np.uint64)
        words.view(np.uint8)[: len(data)] = np.frombuffer(data, dtype=np.uint8)
        self._words, self._image = words, ffi.new("starcat_image *")
        status = lib.starcat_open(self._image, ffi.from_buffer(words), len(data), 0)
        if status != 0:
            raise ProductError(
                f"an onboard image of {len(data):,} bytes is not opened by the C library: "
                f"{NOT_OPENED.get(status, f'error {status}')}; export the artifact for this machine"
            )
        count = int(self._image.n_stars)
        own = np.arange(count) if rows is None else rows
        self._directions = directions
        # Numbers below 0 say why a centroid has no star; they index this table from its end.
        self._rows = np.concatenate([own, [-4, -3, -2, -1]]).astype(np.int32)

    def accepts(self, count: int) -> bool:
        """Return whether a frame of so many centroids is small enough."""
        return count <= int(_onboard.lib.STARCAT_MAX_CENTROIDS)

    def identify(
        self,
        frames: Sequence[Frame],
        settings: Settings,
        prior: Prior | None = None,
        threads: int = 1,
    ) -> Answers:
        """Identify the stars of frames of one camera, with a prior of one frame near it."""
        starts = np.zeros(len(frames) + 1, dtype=np.int64)
        if not frames:
            return Answers(starts, np.zeros(0, ANSWER), np.zeros(0, np.int32))
        if len(frames) == 1:  # by far the most frequent call
            starts[1], px, mag = len(frames[0]), frames[0].centroids_px, frames[0].magnitudes
        else:
            np.cumsum([len(frame) for frame in frames], out=starts[1:])
            px = np.concatenate([*(frame.centroids_px for frame in frames), np.empty((0, 2))])
            given = [frame.magnitudes for frame in frames if frame.magnitudes is not None]
            mag = np.concatenate(given) if given else None
        x, y = np.ascontiguousarray(px.T)
        work = _Work(
            self._image,
            self._directions,
            _camera(frames[0].camera),
            _options(settings),
            (x, y, None if mag is None else np.ascontiguousarray(mag)),
            prior,
        )
        answers = Answers(starts, np.zeros(len(frames), ANSWER), np.full(len(px), -1, np.int32))
        if threads <= 1 or len(frames) <= CHUNK:
            work.run(range(len(frames)), answers)
        else:
            slices = [range(n, min(n + CHUNK, len(frames))) for n in range(0, len(frames), CHUNK)]
            with ThreadPoolExecutor(min(threads, os.cpu_count() or 1)) as pool:
                list(pool.map(lambda part: work.run(part, answers), slices))
        return Answers(starts, answers.frames, self._rows[answers.star_index])


@dataclass(frozen=True)
class _Work:
    """What the calls for the parts of many frames share."""

    image: Any
    directions: Array | None
    camera: Any
    options: Any
    # x, y and, where they are known, magnitudes of all centroids.
    columns: tuple[Array, Array, Array | None]
    prior: Prior | None

    def run(self, part: range, answers: Answers) -> None:
        """Let the library answer some of the frames, in memory of its own."""
        ffi, lib = _onboard.ffi, _onboard.lib
        prior = self.prior
        arrays = (
            ("int64_t[]", answers.starts[part.start :]),
            *(("double[]", column) for column in self.columns),
            ("double[]", None if prior is None else prior.q_body_from_icrs),
            ("double[]", self.directions),
        )
        *pointers, directions = (
            ffi.NULL if array is None else ffi.from_buffer(kind, array) for kind, array in arrays
        )
        error_rad = 0.0 if prior is None else prior.error_rad
        lib.starcat_many(
            self.image,
            self.camera,
            self.options,
            ffi.new("starcat_frames *", [len(part), *pointers, error_rad, directions]),
            ffi.from_buffer("starcat_answer[]", answers.frames[part.start :]),
            ffi.from_buffer("int32_t[]", answers.star_index),
            *_memory(),
        )


_OF_THREAD = threading.local()


def _memory() -> tuple[Any, Any]:
    """Return the memory that this thread's calls work in; half a megabyte, made once."""
    if not hasattr(_OF_THREAD, "memory"):
        ffi = _onboard.ffi
        _OF_THREAD.memory = ffi.new("starcat_workspace *"), ffi.new("starcat_result *")
    found: tuple[Any, Any] = _OF_THREAD.memory
    return found


@lru_cache(maxsize=16)
def _camera(camera: Camera) -> Any:
    """Return a camera as the library has it."""
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
def _options(settings: Settings) -> Any:
    chance = math.log(max(settings.max_false_match_probability, 1e-300))
    # The library takes 0 for a noise that is not stated.
    stated = settings.noise_px or 0.0, settings.noise_mag or 0.0
    options = [settings.tolerance_px, *stated, chance, MAX_STEPS]
    return _onboard.ffi.new("starcat_options *", options)


MOST_FEATURES = 4_000_000
"""Triangles or pairs of a database that are made an image unasked: that takes a second."""


def c_engine(database: Database, method: str, always: bool = True) -> CEngine | None:
    """Return the engine of a database, made once; None where the library does not serve it.

    Unless it is wanted ``always``, no image is made of more than `MOST_FEATURES`.
    """
    if _onboard is None or method not in FEATURES:
        return None
    if database.image is not None and database.image.method != method:
        return None
    if not always and database.image is None and _count(database, method) > MOST_FEATURES:
        return None
    return database.cached(_made, METHODS.index(method))


def _count(database: Database, method: str) -> int:
    product, columns = FEATURES[method]
    return len(database.products[product][columns[0]])


def _made(database: Database, method_number: int) -> CEngine | None:
    if database.image is not None:
        return CEngine(database.image.data)
    method = METHODS[method_number]
    product, columns = FEATURES[method]
    arrays = database.products[product]
    features = np.stack([arrays[column] for column in columns], axis=-1)
    contents = Contents(
        database.name,
        database.epoch_jyear,
        database.camera,
        database.star_id,
        database.directions,
        database.mag,
        method,
        features,
    )
    try:
        made = make_image(contents)
    except ConfigError:  # larger than an image can say
        return None
    if made.most_near > most_stars():
        return None
    exact = np.ascontiguousarray(database.directions[made.star_rows])
    return CEngine(made.data, made.star_rows, exact)
