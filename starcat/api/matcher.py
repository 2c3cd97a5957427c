"""The matcher for files: a picture or a file of centroids instead of arrays."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starcat.errors import ConfigError, count_of
from starcat.geometry.camera import Camera
from starcat.matcher import matcher
from starcat.matcher.prior import PriorLike, prior_of
from starcat.matcher.result import MatchResult
from starcat.matcher.settings import MAX_STEPS
from starcat.version import missing_packages

if TYPE_CHECKING:
    from starcat.images.solve_files import MeasuredFile


class Matcher(matcher.Matcher):
    """A database, a method and the limits of an identification: centroids in, attitude out.

    Open one with `Matcher.open`. `identify` takes arrays, frames, tables and the paths of files.

    Attributes
    ----------
    database : MatcherDatabase
        The stars and the products that the method needs. The other attributes are those of
        `Settings`.
    """

    def _identify_file(self, path: Path, camera: Camera | None, **options: Any) -> MatchResult:
        try:
            from starcat.images.solve_files import measure_picture
        except ModuleNotFoundError as error:
            raise ConfigError(missing_packages(f"reading {path}", error)) from error

        measured = measure_picture(path)
        if measured.shape is not None:
            return self._identify_picture(path, measured, camera, **options)
        if len(measured.frames) != 1:
            raise ConfigError(
                f"{path}: {count_of(len(measured.frames), 'frame')}; read them with "
                "starcat.read_frames, and identify each"
            )
        return self.identify(measured.frames[0], camera, **options)

    def _identify_picture(
        self,
        path: Path,
        measured: MeasuredFile,
        camera: Camera | None,
        *,
        mag: Any,
        sigma_px: Any,
        fov_error: float | None,
        prior: PriorLike | None,
        prior_error_deg: float | None,
        fov_deg: Any,
        explain: bool,  # a picture that is not identified is always explained
    ) -> MatchResult:
        """Identify a picture as ``starcat identify`` does, with the same arguments as a frame."""
        from starcat.images.solve_files import LocalInputs, answers_of
        from starcat.matcher.options import IdentifyOptions

        for name, given in (("mag", mag), ("sigma_px", sigma_px)):
            if given is not None:
                raise ConfigError(
                    f"{name} is for centroids, and {path} is a picture, which is measured; leave "
                    f"{name} out, or read the picture with starcat.read_frames",
                    key=name,
                    fields=(name,),
                )
        known, near = self._camera(camera), prior_of(prior, prior_error_deg)
        if fov_error is not None:
            fov_error = self._checked_fov_error(fov_error)
        if fov_deg is not None:
            field_deg = self.checked_field(fov_deg, fov_error, near)
            fov_deg = field_deg if isinstance(field_deg, tuple) else (field_deg, field_deg)
        chosen = IdentifyOptions(
            fov_error=fov_error,
            fov_deg=fov_deg,
            max_steps=None if self.max_steps == MAX_STEPS else int(self.max_steps),
            time_limit_s=None if self.time_limit_s == math.inf else self.time_limit_s,
        )
        expected = None if near is None else (prior, prior_error_deg)
        local = LocalInputs(camera=known, prior=expected)
        [answer] = answers_of(path, measured, self, chosen, local)
        return answer.result
