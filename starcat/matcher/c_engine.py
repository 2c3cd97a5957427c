"""The C library that flies (``onboard/``), called with an onboard image.

It is compiled when a wheel is built. Where it is missing, or cannot take a frame, the matcher of
numpy serves, with the same rules and the same stars.
"""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache, partial
from importlib import import_module
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from starcat.arrays import Array
from starcat.errors import ConfigError, ProductError
from starcat.geometry.camera import Camera
from starcat.matcher.database import Database
from starcat.matcher.observation import Dropped, Frame
from starcat.matcher.prior import Prior
from starcat.matcher.result import MatchResult, Origin, Refusal, Status, no_match
from starcat.matcher.settings import Settings
from starcat.matcher.stars import ARCSEC
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


def is_compiled() -> bool:
    """Return whether the C library is there."""
    return _onboard is not None


def library_version() -> str | None:
    """Return the version of the C library."""
    if _onboard is None:
        return None
    return str(_onboard.ffi.string(_onboard.lib.starcat_version()).decode())


Explain = Callable[[Frame], "Refusal | None"]


@dataclass(frozen=True)
class BatchResult(Sequence[MatchResult]):
    """The answers of the C library to many frames of one camera."""

    # A record of `ANSWER` a frame; attitudes are zeros unless it is identified.
    records: NDArray[np.void]
    # The centroids of frame n are rows ``starts[n]`` to ``starts[n + 1]`` of ``star_index``.
    starts: NDArray[np.int64]
    # Row of the database; -1 where none; a key of `DROPPED` where the centroid was not used.
    star_index: NDArray[np.int32]
    frames: Sequence[Frame]
    database: Database
    noise_px: float | None = None  # noise of a centroid, where it was stated
    # Searches a frame again and says why it gets no answer, which the library does not.
    explain: Explain | None = None
    origin: Origin = "lost_in_space"  # where the library looked for the stars

    def __len__(self) -> int:
        return len(self.records)

    @property
    def is_whole(self) -> bool:
        """Whether the library took all frames; a camera or limit may be beyond it."""
        return all(code in STATUSES for code in self.records["status"].tolist())

    @property
    def status(self) -> list[Status]:
        """What each frame came to."""
        return [STATUSES[code] for code in self.records["status"].tolist()]

    @property
    def seconds(self) -> NDArray[np.float64]:
        """Time that each frame took, without the call."""
        return np.asarray(self.records["seconds"])

    @property
    def q_body_from_icrs(self) -> NDArray[np.float64]:
        """Scalar-last attitudes, shape (N, 4); NaN unless identified."""
        found = self.records
        return np.where(found["status"][:, None] == 0, found["q_body_from_icrs"], np.nan)

    @overload
    def __getitem__(self, frame: int) -> MatchResult: ...
    @overload
    def __getitem__(self, frame: slice) -> list[MatchResult]: ...
    def __getitem__(self, frame: int | slice) -> MatchResult | list[MatchResult]:
        if isinstance(frame, slice):
            return [self[n] for n in range(*frame.indices(len(self)))]
        frame = range(len(self))[frame]
        star = self.star_index[self.starts[frame] : self.starts[frame + 1]]
        found, asked = self.records[frame], self.frames[frame]
        facts: dict[str, Any] = {
            "origin": self.origin,
            "time_s": float(found["seconds"]),
            "frame": asked,
            "database": self.database,
            "noise_px": self.noise_px,
        }
        code, dropped = int(found["status"]), _dropped(star)
        if STATUSES[code] != "identified":
            return no_match(len(star), dropped, self._why(code, asked), **facts)
        answer = MatchResult(
            "identified",
            np.maximum(star, -1),
            found["matrix"].copy(),
            float(found["residual_rad"]) * ARCSEC,
            math.exp(found["log_chance"]),
            dropped,
            asked.camera,
            **facts,
        )
        # The library's own, which rounds otherwise than the one that the matrix makes.
        vars(answer)["q_body_from_icrs"] = found["q_body_from_icrs"].copy()
        return answer

    def _why(self, code: int, frame: Frame) -> Refusal | Callable[[], Refusal | None] | None:
        """Return why a frame has no answer, or what finds it out."""
        if code == OUT_OF_STEPS:
            return Refusal("steps")
        if STATUSES[code] == "too_few_stars":
            return Refusal("too_few_stars")
        return None if self.explain is None else partial(self.explain, frame)


def _dropped(star: NDArray[np.int32]) -> Dropped:
    """Return row and reason of every centroid that was not used, repeats last."""
    if star.min(initial=-1) >= -1:
        return ()
    rows = np.flatnonzero(star < -1)
    reasons = [(int(row), DROPPED[int(star[row])]) for row in rows]
    return tuple(sorted(reasons, key=lambda item: item[1] == "duplicate"))


class CEngine:
    """An onboard image in memory, and the C library that reads it."""

    def __init__(
        self,
        database: Database,
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
        self._database, self._directions = database, directions
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
        explain: Explain | None = None,
    ) -> BatchResult:
        """Identify the stars of frames of one camera, with a prior of one frame near it."""
        starts = np.zeros(len(frames) + 1, dtype=np.int64)
        np.cumsum([len(frame) for frame in frames], out=starts[1:])
        records, star_index = np.zeros(len(frames), ANSWER), np.full(starts[-1], -1, np.int32)
        parts = [range(n, min(n + CHUNK, len(frames))) for n in range(0, len(frames), CHUNK)]
        run = partial(self._run, frames, settings, prior, (starts, records, star_index))
        if threads <= 1 or len(parts) <= 1:
            for part in parts:
                run(part)
        else:
            with ThreadPoolExecutor(min(threads, os.cpu_count() or 1)) as pool:
                list(pool.map(run, parts))
        return BatchResult(
            records,
            starts,
            self._rows[star_index],
            frames,
            self._database,
            settings.noise_px,
            explain,
            "lost_in_space" if prior is None else "tracking",
        )

    def _run(
        self,
        frames: Sequence[Frame],
        settings: Settings,
        prior: Prior | None,
        answers: tuple[NDArray[np.int64], NDArray[np.void], NDArray[np.int32]],
        part: range,
    ) -> None:
        """Let the library answer some of the frames, in memory of its own."""
        ffi, lib = _onboard.ffi, _onboard.lib
        starts, records, star_index = answers
        some = [frames[n] for n in part]
        first, last = starts[part.start], starts[part.stop]
        px = some[0].centroids_px
        mags = [frame.magnitudes for frame in some if frame.magnitudes is not None]
        if len(some) > 1:  # one is by far the most frequent call
            px = np.concatenate([frame.centroids_px for frame in some])
        arrays = (
            ("int64_t[]", starts[part.start : part.stop + 1] - first),
            *(("double[]", column) for column in np.ascontiguousarray(px.T)),
            ("double[]", np.concatenate(mags) if mags else None),
            ("double[]", None if prior is None else prior.q_body_from_icrs),
            ("double[]", self._directions),
        )
        *pointers, directions = (
            ffi.NULL if array is None else ffi.from_buffer(kind, array) for kind, array in arrays
        )
        error_rad = 0.0 if prior is None else prior.error_rad
        lib.starcat_many(
            self._image,
            _camera(some[0].camera),
            _options(settings),
            ffi.new("starcat_frames *", [len(part), *pointers, error_rad, directions]),
            ffi.from_buffer("starcat_answer[]", records[part.start : part.stop]),
            ffi.from_buffer("int32_t[]", star_index[first:last]),
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
    options = [settings.tolerance_px, *stated, chance, 0.0, MAX_STEPS]
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
    if not always and database.image is None:
        product, (column, *_) = FEATURES[method]
        if len(database.products[product][column]) > MOST_FEATURES:
            return None
    return database.cached(_made, METHODS.index(method))


def _made(database: Database, method_number: int) -> CEngine | None:
    if database.image is not None:
        return CEngine(database, database.image.data)
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
    if made.most_near > _onboard.lib.STARCAT_MAX_STARS:
        return None
    exact = np.ascontiguousarray(database.directions[made.star_rows])
    return CEngine(database, made.data, made.star_rows, exact)
