"""The matcher for files: a picture or a file of centroids instead of arrays."""

from __future__ import annotations

from pathlib import Path

from starcat.errors import ConfigError
from starcat.geometry.camera import Camera
from starcat.matcher import matcher
from starcat.matcher.result import MatchResult
from starcat.version import missing_packages


class Matcher(matcher.Matcher):
    """`starcat.matcher.matcher.Matcher`, whose `identify` also takes the path of a file."""

    def _identify_file(self, path: Path, camera: Camera | None) -> MatchResult:
        try:
            from starcat.images.solve_files import LocalInputs, identify_file
        except ModuleNotFoundError as error:
            raise ConfigError(missing_packages(f"reading {path}", error)) from error

        answers = identify_file(path, self, local=LocalInputs(camera=camera))
        if len(answers.measured.frames) != 1:
            raise ConfigError(
                f"{path}: {len(answers.measured.frames)} frames; read them with "
                "starcat.read_frames, and identify each"
            )
        return next(iter(answers)).result
