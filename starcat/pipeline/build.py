"""Build a database: run all stages in a temporary folder, which is then renamed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from starcat.arguments import check_type, path_of, whole_number, wrong_type
from starcat.catalog.store.wire import input_paths
from starcat.database.manifest import database_files, read_manifest, software_versions
from starcat.errors import BuildError, OutputError, StarcatError
from starcat.geometry.camera import Camera
from starcat.pipeline.cost import Cost
from starcat.pipeline.draft import Draft, run
from starcat.pipeline.log import write_build_log
from starcat.pipeline.report.report import CoverageReport
from starcat.pipeline.report_data import FilterCoverage
from starcat.pipeline.simulation.selftest import Rates
from starcat.pipeline.specs.build_spec import BuildSpec
from starcat.pipeline.specs.reading import read_spec, spec_from_dict
from starcat.pipeline.stages import BUILD
from starcat.pipeline.starter import Starter
from starcat.progress import Progress, no_progress
from starcat.resources import PathLike
from starcat.storage.atomic import (
    Outcome,
    another_is_there,
    check_final,
    move_into_place,
    whole_folder,
)


@dataclass(frozen=True)
class Built:
    """A finished build.

    Attributes
    ----------
    folder : Path
        The database.
    outcome : Outcome
        ``written``, ``unchanged`` or ``replaced``: what happened to the folder.
    manifest : dict[str, Any]
        Manifest of the database.
    filters : tuple[FilterCoverage, ...]
        Stars left by each filter.
    coverage : CoverageReport
        Coverage by the guide stars.
    rates : tuple[Rates, ...]
        Rates of the self-test: clean and hard frames, and the same without magnitudes.
    problems : tuple[str, ...]
        The first malformed records.
    warnings : tuple[str, ...]
        Possible problems, such as holes of the tiling.
    times_s : dict[str, float]
        Seconds by stage.
    """

    folder: Path
    outcome: Outcome
    manifest: dict[str, Any]
    filters: tuple[FilterCoverage, ...]
    coverage: CoverageReport
    rates: tuple[Rates, ...]
    problems: tuple[str, ...]
    warnings: tuple[str, ...]
    times_s: dict[str, float]

    def __repr__(self) -> str:
        """Return the folder and the identification rates in one line."""
        clean, hard = self.rates[:2]
        stars = self.manifest["products"]["stars"]["rows"]
        return (
            f"<Built {self.folder} ({self.outcome}): {stars:,} guide stars, identified "
            f"{clean.identified_share:.1%} of clean and {hard.identified_share:.1%} of hard fields>"
        )


def build(
    spec: BuildSpec | Mapping[str, Any] | PathLike,
    output: PathLike = "dist",
    *,
    inputs: Mapping[str, PathLike | Sequence[PathLike]] | None = None,
    replace: bool = False,
    workers: int = 2,
    progress: Progress | None = None,
    announce: Callable[[Cost], None] | None = None,
    max_memory_bytes: int | None = None,
) -> Built:
    """Build a guide-star database, check it, and prove that it identifies its own fields.

    Parameters
    ----------
    spec : BuildSpec, mapping, str or path-like
        A spec, a mapping with the keys of a spec file, or a spec file (TOML).
    output : str or path-like, default "dist"
        Folder in which the folder ``<name>-<version>`` is made.
    inputs : mapping of str to path or paths, optional
        By source: files, folders or the address of a HATS catalog. By default they are searched.
    replace : bool, default False
        Whether a different database of the same name and version may be replaced.
    workers : int, default 2
        Number of threads; the database does not depend on it.
    progress : callable, optional
        Called with (stage, done, total).
    announce : callable, optional
        Called once with the estimated cost before any product is made.
    max_memory_bytes : int, optional
        A build that needs more memory is refused; by default, more than the free memory.

    Returns
    -------
    Built
        The folder, the manifest, rates of the self-test, warnings and times.

    Raises
    ------
    ConfigError, SourceError, BuildError, OutputError
        In the same cases as ``starcat build``.
    """
    if isinstance(spec, Camera):
        raise wrong_type(
            "spec", spec, "a spec; starcat.init(camera, name).spec is one for a camera"
        )
    if isinstance(spec, Starter):
        raise wrong_type("spec", spec, "its spec, which is its attribute 'spec'")
    if isinstance(spec, Mapping):
        spec = spec_from_dict(dict(spec), "spec")
    elif not isinstance(spec, BuildSpec):
        spec = read_spec(spec)
    check_type("inputs", inputs or {}, Mapping, "a mapping of the names of sources to paths")
    files = {source: input_paths("inputs", paths) for source, paths in (inputs or {}).items()}
    workers = whole_number("workers", workers, 1)
    final = path_of("output", output) / f"{spec.name}-{spec.version}"
    listed = database_files if replace else None
    check_final(final, listed)
    if not replace:
        _expect_same_spec(final, spec)
    draft = Draft(
        spec,
        files,
        workers=workers,
        progress=progress or no_progress,
        announce=announce,
        max_memory_bytes=max_memory_bytes,
    )
    with whole_folder(final) as partial:
        draft.folder = partial
        try:
            run(draft, BUILD)
        except BuildError as error:
            if not draft.manifest:
                raise
            error.built = _built(draft, partial, "written")
            raise
        outcome = move_into_place(partial, final, listed)
        draft.clock.lap("verify")
    try:
        write_build_log(final, outcome, draft.clock.times_s)
    except OutputError as error:  # the database has its name already
        draft.note("write_build_log", f"{error}; the database is complete without this log")
    return _built(draft, final, outcome)


def _expect_same_spec(final: Path, spec: BuildSpec) -> None:
    """Raise before the build if the folder has a database of another spec."""
    if not final.exists() or (final.is_dir() and not any(final.iterdir())):
        return
    try:
        manifest = read_manifest(final)
    except StarcatError:
        raise another_is_there(final) from None
    if manifest["spec"] != spec.recorded() or manifest["software"] != software_versions():
        raise another_is_there(final)


def _built(draft: Draft, folder: Path, outcome: Outcome) -> Built:
    return Built(
        folder,
        outcome,
        draft.manifest,
        draft.filters,
        draft.coverage,
        draft.rates,
        draft.problems,
        draft.warnings,
        draft.clock.times_s,
    )
