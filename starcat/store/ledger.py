"""The ledger of a run: which of its tasks are done, and the checksums of what they wrote.

A store is made in a hidden folder beside its final name. Each task writes its files there and
then, as its last step, one line of facts that says so. A run that was killed goes on from these:
a task counts as done if its files are there and have their checksums.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from isal import isal_zlib

from starcat.errors import ConfigError, OutputError
from starcat.storage.atomic import writing
from starcat.storage.digests import json_bytes

OPTIONS_NAME = "options.json"
RESUME_ADVICE = "what is done is kept: make room, then go on with resume=True"
_DONE = "done"


def _checksum(path: Path) -> str:
    """Return the CRC-32 of a file: it tells what was left half-written or damaged, not changed."""
    checksum = 0
    with path.open("rb") as file:
        while data := file.read(1 << 20):
            checksum = isal_zlib.crc32(data, checksum)
    return f"{checksum:08x}"


@dataclass(frozen=True)
class ResumePlan:
    """The hidden folder of a run."""

    folder: Path  # ``.<name>.work`` beside the final name

    @classmethod
    def of(cls, final: Path) -> ResumePlan:
        """Return the folder for a store."""
        return cls(final.absolute().parent / f".{final.name}.work")

    def __truediv__(self, name: str) -> Path:
        """Return a path in the folder."""
        return self.folder / name

    def begin(self, options: Mapping[str, Any], *, resume: bool) -> None:
        """Make the folder, or take up the run that was begun in it."""
        path = self / OPTIONS_NAME
        if path.is_file() and not resume:
            raise OutputError(
                f"{self.folder}: an unfinished run is there; go on with it by resume=True, or "
                "remove the folder to start anew",
                path=self.folder,
                fields=("resume=True",),
            )
        if path.is_file():
            self._check_options(json.loads(path.read_text(encoding="utf-8")), options)
            return
        with writing(self.folder.parent, "choose another output", ("output",)):
            shutil.rmtree(self.folder, ignore_errors=True)
            (self / _DONE).mkdir(parents=True)
            path.write_bytes(json_bytes(dict(options)))

    def _check_options(self, before: Mapping[str, Any], now: Mapping[str, Any]) -> None:
        for key, value in now.items():
            if before.get(key) != value:
                raise ConfigError(
                    f"{self.folder}: the unfinished run has {key} {_short(before.get(key))}, this "
                    f"one {_short(value)}; resume it with the same, or remove the folder to start "
                    "anew",
                    key=key,
                    value=value,
                )

    def done(self, name: str) -> dict[str, Any] | None:
        """Return the result of a task that is done."""
        path = self._record(name)
        try:
            record = json.loads(path.read_bytes())
            files: dict[str, str] = record["files"]
            if all(_checksum(self / file) == checksum for file, checksum in files.items()):
                result: dict[str, Any] = record["result"]
                return result
        except (OSError, ValueError, KeyError, TypeError):
            pass
        return None

    def record(self, name: str, result: Mapping[str, Any], written: Iterable[Path]) -> None:
        """Record that a task is done."""
        files = {file.relative_to(self.folder).as_posix(): _checksum(file) for file in written}
        path = self._record(name)
        # Two workers may do the same task when one of them was thought dead: both write the same.
        partial = path.with_name(f".{path.name}.{os.getpid()}")
        partial.write_bytes(json_bytes({"files": files, "result": dict(result)}))
        partial.replace(path)

    def _record(self, name: str) -> Path:
        return self.folder / _DONE / f"{name}.json"


@dataclass(frozen=True)
class Task:
    """A call of a function that is made once: what the ledger has is not done again.

    The function returns its result as plain values, and the files that it wrote.
    """

    plan: ResumePlan
    name: str  # unique in the run
    function: Callable[..., tuple[dict[str, Any], list[Path]]]
    arguments: tuple[Any, ...]
    # whether an earlier result holds for the arguments; None where it always does
    is_valid: Callable[..., bool] | None = None

    def run(self) -> dict[str, Any]:
        """Do the task and record it, if it is not done."""
        before = self.plan.done(self.name)
        if before is not None and (self.is_valid is None or self.is_valid(before, *self.arguments)):
            return before
        with writing(self.plan.folder.parent, RESUME_ADVICE):
            result, written = self.function(*self.arguments)
            self.plan.record(self.name, result, written)
        return result


def _short(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:60]}…"
