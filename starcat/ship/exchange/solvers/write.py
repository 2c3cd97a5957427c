"""Export a database for another solver: the solver's files, the stars, and their origin."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow as pa
from pyarrow import csv

from starcat.database.verify import check_database
from starcat.errors import FileMissing, SourceError
from starcat.results import entry
from starcat.ship.exchange.formats import SOLVER_FORMATS
from starcat.ship.exchange.solvers.astap import write_astap
from starcat.ship.exchange.solvers.lost import write_lost
from starcat.ship.exchange.solvers.programs import write_astrometry_net, write_tetra3rs
from starcat.ship.exchange.solvers.sky import SolverSky, sky_of
from starcat.ship.exchange.solvers.tetra import write_tetra
from starcat.storage.atomic import (
    check_final,
    file_sha256,
    json_bytes,
    move_into_place,
    whole_folder,
)
from starcat.storage.regular_files import read_regular_file

PROVENANCE_NAME = "provenance.json"
STARS_NAME = "stars.csv"
MAX_PROVENANCE_BYTES = 64 << 20

_Write = Callable[[SolverSky, Path], dict[str, Any]]


@dataclass(frozen=True, repr=False)
class ExportedSolver:
    """The files that were written for a solver.

    Attributes
    ----------
    solver : str
        Name of the solver.
    folder : Path
        Folder of the files.
    main : str
        Name of the file or folder that the solver loads.
    made : dict[str, Any]
        Figures of the solver's files.
    facts : dict[str, Any]
        Content of provenance.json.
    """

    solver: str
    folder: Path
    main: str = field(repr=False)
    made: dict[str, Any] = field(repr=False)
    facts: dict[str, Any] = field(metadata=entry(is_spread=True))

    def __repr__(self) -> str:
        return f"<ExportedSolver {self.folder}: for {self.solver}>"


def export_solver(
    database: Path, solver: str, output: Path | None = None, *, replace: bool = False
) -> ExportedSolver:
    """Write a database for another solver, one of `SOLVER_FORMATS`."""
    sky = sky_of(check_database(database))
    final = output or Path(f"{sky.name}-{solver}")
    write, suffix = _WRITERS[solver]
    listed = _listed_files if replace else None
    check_final(final, listed)
    with whole_folder(final.absolute()) as unfinished:
        main = unfinished / f"{sky.name}{suffix}"
        figures = write(sky, main)
        files = sorted(path for path in unfinished.rglob("*") if path.is_file())
        digests = {path.relative_to(unfinished).as_posix(): file_sha256(path) for path in files}
        facts = {"solver": solver, **sky.provenance, **figures, "sha256": digests}
        csv.write_csv(_stars(sky), unfinished / STARS_NAME)
        (unfinished / PROVENANCE_NAME).write_bytes(json_bytes(facts))
        move_into_place(unfinished, final.absolute(), listed)
    return ExportedSolver(solver, final, main.name, figures, facts)


def _listed_files(folder: Path) -> set[str]:
    """Return the names of the files that an earlier export has written into a folder."""
    try:
        facts = json.loads(read_regular_file(folder / PROVENANCE_NAME, MAX_PROVENANCE_BYTES))
        digests = dict(facts["sha256"])
    except (FileMissing, SourceError, ValueError, TypeError, KeyError, RecursionError):
        return set()
    return {PROVENANCE_NAME, STARS_NAME, *digests}


def _stars(sky: SolverSky) -> pa.Table:
    """Return the stars in the solver's order, to look up names by row."""
    return pa.table(
        {
            "row": pa.array(range(1, len(sky.mag) + 1)),
            "star_id": sky.star_id,
            "designation": pa.array(sky.designation),
            "ra_deg": sky.ra_deg,
            "dec_deg": sky.dec_deg,
            "mag": sky.mag,
        }
    )


_WRITERS: dict[str, tuple[_Write, str]] = dict(
    zip(
        SOLVER_FORMATS,
        (
            (partial(write_tetra, solver="tetra3"), ".npz"),
            (partial(write_tetra, solver="cedar-solve"), ".npz"),
            (write_tetra3rs, ".bin"),
            (write_lost, ".dat"),
            (write_astrometry_net, ""),
            (write_astap, ""),
        ),
        strict=True,
    )
)
