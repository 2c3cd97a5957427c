"""A camera of which nothing is known, from photographs: its field, lens, limit and noise.

The frames are identified with a database for many fields of view. The field is the field of a
lens without distortion, as in a spec. If the stars support terms of distortion, the result also has
a camera with these. The limit is the magnitude from which stars are seen half as often as the
bright ones.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from starcat.arrays import Array, Mask, Rows
from starcat.errors import CalibrationError, ConfigError, count_of
from starcat.frames.calibration.fit import Fit, Seen, camera_of, project, values_of
from starcat.frames.calibration.rounds import supported_fit
from starcat.frames.images.measure import LocalInputs
from starcat.frames.images.solve_files import FrameAnswer, identify_either_way
from starcat.geometry.camera import Camera
from starcat.matcher.matcher import Matcher
from starcat.matcher.options import IdentifyOptions
from starcat.pipeline.specs.build_spec import BuildSpec, CameraSpec
from starcat.pipeline.specs.camera_file import camera_toml
from starcat.progress import Progress, no_progress

ROUNDS_PX = (6.0, 4.0, 3.0, 2.0)
"""Largest distances of a centroid from its star, in the rounds of fitting the lens."""

ERROR_OF_LENS = 0.005
"""Relative error of the field from one picture due to distortion, which depends on where the stars
are on the detector: the scatter of the fields of an IMX219 with 7 % of distortion in the corner."""

BRIGHT = 15
"""Smallest number of bright stars from which the share of seen stars is measured."""

AT_THE_END_MAG = 0.1
"""A limit this near to the faintest star of the database is the limit of the database."""


@dataclass(frozen=True)
class FirstCamera:
    """The camera of photographs, found from their stars."""

    camera: Camera  # camera without distortion, in the middle of its fields
    fov_error_deg: float  # standard error of the field across the width
    fit: Fit  # fit of the terms of the lens that the stars support
    reach_mag: float  # magnitude from which stars are seen half as often as bright ones
    n_reach: int  # number of stars that ``reach_mag`` is measured from
    is_deeper: bool  # true if the camera sees nearly all stars of the database
    names: tuple[str, ...]  # names of the pictures that were identified
    n_files: int
    flip: bool | None  # the ``flip`` with which the pictures were identified
    frame_remarks: tuple[str, ...] = ()  # what of the files was not used or was assumed

    @property
    def lens(self) -> Camera:
        """The camera with the distortion that the stars support."""
        return camera_of(self.fit.values, (self.camera.width_px, self.camera.height_px))

    @property
    def has_distortion(self) -> bool:
        """Whether the stars support any distortion."""
        return len(self.fit.free) > 1

    @property
    def spec_camera(self) -> CameraSpec:
        """The camera as it is written in a spec."""
        width, height = self.camera.width_px, self.camera.height_px
        return CameraSpec(
            width_px=width, height_px=height, fov_x_deg=round(self.camera.fov_x_deg, 4)
        )

    def remarks(self, band: str) -> list[str]:
        """Return comments for a spec: the origin of its values and their errors, in lines."""
        count, stars = len(self.names), len(self.fit.seen)
        named = ", ".join(self.names[:5]) + (", ..." if count > 5 else "")
        seen = f"{'at least ' if self.is_deeper else ''}{self.reach_mag:.2f}"
        lines = [
            f"From {count_of(self.n_files, 'file')}, {count} identified: {named}.",
            f"camera.fov_x_deg = {self.camera.fov_x_deg:.4f} +- {self.fov_error_deg:.4f}: of a "
            "lens without distortion, from the stars of the pictures.",
            f"Stars of {band} = {seen} are seen half as often as bright ones "
            f"(+- {self._reach_error:.2f}, from {self.n_reach} stars).",
            f"self_test.noise_px = {self.noise_px:g} +- "
            f"{self.fit.noise_px / math.sqrt(2.0 * max(1, 2 * stars - 4)):.2g}: centroids about "
            f"the fitted lens, on each axis, from {stars} stars.",
        ]
        lines += [f"{remark}." for remark in self.frame_remarks]
        if self.flip is not None:
            upside = "upside down (flip)" if self.flip else "as they are (no flip)"
            lines.append(f"The pictures were read {upside}: state it when they are identified.")
        if self.has_distortion:
            terms = (f"{name} +- {error:.2g}" for name, error in self.fit.errors.items())
            lines += [f"The lens ({', '.join(terms)}), as a camera file:"]
            lines += [f"  {line}" for line in camera_toml(self.lens).splitlines() if line]
        return lines

    @property
    def noise_px(self) -> float:
        """Noise of a centroid, for a spec."""
        return min(50.0, round(self.fit.noise_px, 3))

    @property
    def _reach_error(self) -> float:
        """Error of the limit, mag; per magnitude there are about three times as many stars."""
        return 0.5 / math.sqrt(max(1.0, 0.3 * self.n_reach))


def spec_of_photos(
    spec: BuildSpec, noise_px: float, reach_mag: float, *, is_stated: bool = False
) -> tuple[BuildSpec, str]:
    """Return a spec with the noise of the pictures, and a line about the origin of its limit."""
    limit_mag, origin = spec.selection.faint_limit_mag, "what the pictures reach"
    if limit_mag > round(reach_mag, 2):
        origin = "deeper than the pictures, for 10 stars in nearly all fields"
    if is_stated:
        origin = "as stated"
    test = spec.self_test.model_copy(update={"noise_px": noise_px})
    remark = f"selection.faint_limit_mag = {limit_mag:g}: {origin}."
    return spec.model_copy(update={"self_test": test}), remark


def first_camera(
    matcher: Matcher,
    paths: Sequence[Path],
    fov_deg: tuple[float, float],
    size_px: tuple[int, int] | None = None,
    progress: Progress = no_progress,
) -> FirstCamera:
    """Find the camera of pictures or files of centroids; `CalibrationError` if that fails.

    A database serves another range of fields for a frame that is not square than for a square one.
    Only the part of ``fov_deg`` that it serves is searched.
    """
    flip: bool | None = None
    searched_deg = fov_deg
    identified: list[FrameAnswer] = []
    why = []
    for number, path in enumerate(paths, start=1):
        options = IdentifyOptions(fov_deg=fov_deg, size_px=size_px, flip=flip)
        try:
            answers, frames = identify_either_way(
                path, matcher, options, LocalInputs(may_narrow=True)
            )
        except ConfigError as error:
            if error.parameter != "fov_deg":
                raise
            why.append(f"{path.name}: these fields are not searched in a frame of its shape")
            continue
        searched_deg = answers.options.fov_deg or fov_deg
        for frame in frames:
            refusal = frame.result.refusal
            if frame.result.ok:
                identified.append(frame)
            else:
                words = frame.result.status if refusal is None else refusal.message
                why.append(f"{frame.frame.name}: {words}")
        if any(frame.result.ok for frame in frames):
            flip = answers.options.flip
        progress("identify", number, len(paths))
    if not identified:
        raise CalibrationError(
            f"none of {len(paths)} pictures is identified with fields of {searched_deg[0]:.3g} to "
            f"{searched_deg[1]:.3g} deg ({'; '.join(why[:3])})",
            hint=(
                "Give sharper pictures of the sky alone",
                "the range of their fields ({fov_range})",
                "the data of the lens ({fov_x_deg})",
            ),
        )
    return _camera_of(matcher, identified, len(paths), flip)


def _camera_of(
    matcher: Matcher, identified: list[FrameAnswer], n_files: int, flip: bool | None
) -> FirstCamera:
    cameras = [answer.result.camera for answer in identified if answer.result.camera is not None]
    sizes = {(camera.width_px, camera.height_px) for camera in cameras}
    if len(sizes) > 1:
        listed = ", ".join(f"{width} x {height}" for width, height in sorted(sizes))
        raise CalibrationError(f"the pictures have {listed} px", hint="give pictures of one camera")
    focal_px = np.array([camera.focal_length_px for camera in cameras])
    errors = [answer.result.focal_length_error_px or 0.0 for answer in identified]
    middle = cameras[0].with_focal_length(float(np.median(focal_px)))
    spread = 1.2533 * float(np.std(focal_px)) / math.sqrt(len(identified))
    of_lens = ERROR_OF_LENS * middle.focal_length_px / math.sqrt(len(identified))
    error = max(spread, min(errors), of_lens)
    fit, reach_mag, seen = _lens_and_reach(matcher, identified, middle)
    faintest = float(matcher.database.mag.max())
    return FirstCamera(
        middle,
        middle.fov_x_deg * error / middle.focal_length_px,
        fit,
        reach_mag,
        seen,
        reach_mag > faintest - AT_THE_END_MAG,
        tuple(answer.frame.name for answer in identified),
        n_files,
        flip,
        tuple(
            dict.fromkeys(remark for answer in identified for remark in answer.result.frame_remarks)
        ),
    )


def _lens_and_reach(
    matcher: Matcher, identified: list[FrameAnswer], camera: Camera
) -> tuple[Fit, float, int]:
    """Return the lens, the magnitude that the frames reach, and the number of stars seen to it."""
    size_px, database = (camera.width_px, camera.height_px), matcher.database
    values = values_of(camera)
    matrices = np.array([answer.result.matrix for answer in identified])
    # At first the stars that were identified, then all that are as bright.
    rows = [np.flatnonzero(answer.result.star_index >= 0) for answer in identified]
    stars = [answer.result.star_index[row] for answer, row in zip(identified, rows, strict=True)]
    fit = supported_fit(
        _seen(identified, rows, [database.directions[star] for star in stars], matrices),
        values, size_px, ROUNDS_PX[0],
    )  # fmt: skip
    mag, is_seen = np.empty(0), np.empty(0, dtype=bool)
    limit_mag = float(max(database.mag[star].max() for star in stars))
    for reach_px in ROUNDS_PX:
        rows, directions, mags, near = [], [], [], []
        for answer, matrix in zip(identified, fit.seen.matrices, strict=True):
            inside, predicted = _in_frame(database.directions @ matrix.T, fit.values, size_px)
            offset = answer.frame.centroids_px[:, None] - predicted
            square = np.einsum("nmi,nmi->nm", offset, offset)
            nearest, least = square.argmin(axis=0), square.min(axis=0)
            # A star and its centroid are the nearest to each other.
            is_spot = (square.argmin(axis=1)[nearest] == np.arange(len(inside))) & (
                least <= reach_px**2
            )
            mags.append(database.mag[inside])
            near.append(is_spot)
            use = is_spot & (mags[-1] <= limit_mag)
            rows.append(nearest[use])
            directions.append(database.directions[inside[use]])
        mag, is_seen = np.concatenate(mags), np.concatenate(near)
        limit_mag = _reach(mag, is_seen)
        if min(len(row) for row in rows) < 4:
            break  # a frame would have fewer stars than were identified in it
        fit = supported_fit(
            _seen(identified, rows, directions, fit.seen.matrices), fit.values, size_px, reach_px
        )
    return fit, limit_mag, int(np.count_nonzero(is_seen & (mag <= limit_mag)))


def _seen(
    identified: list[FrameAnswer], rows: list[Rows], directions: list[Array], matrices: Array
) -> Seen:
    px = [answer.frame.centroids_px[row] for answer, row in zip(identified, rows, strict=True)]
    frame = np.repeat(np.arange(len(identified)), [len(row) for row in rows])
    return Seen(frame, np.concatenate(px), np.concatenate(directions), matrices)


def _in_frame(body: Array, values: Array, size_px: tuple[int, int]) -> tuple[Rows, Array]:
    """Return the rows of directions that lie in the frame, and their pixels."""
    half = 0.5 * math.hypot(*size_px) / values[0]
    rows = np.flatnonzero(body[:, 2] > 1.0 / math.hypot(1.0, 1.2 * half))
    px = project(values, body[rows])
    inside = ((px > 0.0) & (px < size_px)).all(axis=1)
    return rows[inside], px[inside]


def _reach(mag: Array, is_seen: Mask) -> float:
    """Return the magnitude from which stars are seen half as often as the bright ones.

    Clouds and trees hide stars of all magnitudes, so the share seen among bright stars is the
    reference. Up to the returned magnitude, the number of stars seen exceeds half of the number
    expected from that share by the most.
    """
    order = np.argsort(mag, kind="stable")
    seen = np.cumsum(is_seen[order])
    count = np.arange(1, len(seen) + 1)
    first = min(BRIGHT, len(seen)) - 1
    usual = float((seen / count)[first:].max())
    return float(mag[order][int((seen - 0.5 * usual * count).argmax())])
