"""The rows of a benchmark: its options, its databases, its failures, and its exit code.

A benchmark ends with 0 if all of its rows ran and are right, with 1 if one of them failed, and
with `LACKING` if every row that did not run needs something that is not there. Limits of time
are judged in the full form only: the quick one shows that every row runs and is right.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from synthetic import catalogs_folder

if TYPE_CHECKING:
    from starcat.pipeline.build import Built

LACKING = 77
"""Exit status of a benchmark that cannot run here, as of tests in Automake."""

FILES: dict[str, dict[str, str]] = {
    "sao-12deg": {"sao": "sao.dat.gz"},
    "sao-12deg-512": {"sao": "sao.dat.gz"},
    "sao-6deg": {"sao": "sao.dat.gz"},
    "gaia-12deg": {},
    "tycho2-12deg": {"tycho2": "tyc2.dat.gz"},
    "2mass-8x6": {"2mass": "psc_estimated.gz"},
}
"""The presets, and the file of the catalogs that each is built from."""


class LackingError(Exception):
    """A program, a package or a file is not there."""


class Options(argparse.ArgumentParser):
    """The command line of a benchmark: `--quick`, and sizes that have a quick value too."""

    def __init__(self, text: str | None) -> None:
        super().__init__(description=(text or "").split("\n")[0])
        self.add_argument(
            "--quick", action="store_true", help="the small sizes; no limit is judged"
        )
        self._sizes: dict[str, tuple[Any, Any]] = {}

    def size(self, flag: str, full: float, quick: float, what: str) -> None:
        """Add a number that `--quick` makes smaller, unless it is given."""
        self.add_argument(flag, type=type(full), help=f"{what} ({full}; quick: {quick})")
        self._sizes[flag.lstrip("-").replace("-", "_")] = full, quick

    def asked(self) -> argparse.Namespace:
        """Return what was asked for."""
        given = self.parse_args()
        for name, (full, quick) in self._sizes.items():
            if getattr(given, name) is None:
                setattr(given, name, quick if given.quick else full)
        return given


@dataclass
class Rows:
    """What became of the rows of a benchmark."""

    failed: list[str] = field(default_factory=list)
    lacking: list[str] = field(default_factory=list)

    @contextmanager
    def row(self, name: str) -> Iterator[None]:
        """Run one row; its error is printed at the end, and the other rows run too."""
        try:
            yield
        except LackingError as error:
            self.lacking.append(f"{name}: {error}")
        except Exception as error:
            traceback.print_exc()
            self.failed.append(f"{name}: {type(error).__name__}: {error}")

    def expect(self, is_right: bool, what: str) -> None:
        """Have the benchmark fail unless something is right."""
        if not is_right:
            self.failed.append(what)


def ended(main: Callable[[Rows], None]) -> NoReturn:
    """Run a benchmark to its end, say what failed and leave with its status."""
    rows = Rows()
    try:
        main(rows)
    except LackingError as error:
        rows.lacking.append(str(error))
    for what, told in (("failed", rows.failed), ("not there", rows.lacking)):
        for line in told:
            print(f"{what}: {line}", file=sys.stderr)
    sys.exit(1 if rows.failed else LACKING if rows.lacking else 0)


def need(*packages: str) -> None:
    """Ask for packages that starcat itself runs without."""
    for name in packages:
        if find_spec(name) is None:
            raise LackingError(f"the package {name}: pip install {name}")


def need_catalogs(*names: str) -> None:
    """Ask for files of the folder of catalogs."""
    for path in (catalogs_folder() / name for name in names):
        if not path.is_file():
            raise LackingError(f"{path.name} in {path.parent}; set STARCAT_CATALOGS to its folder")


def database(name: str, folder: Path, changes: dict[str, str] | None = None) -> Built:
    """Build a preset, with changes, from the catalogs in $STARCAT_CATALOGS."""
    # Imported here, so that a benchmark that lacks something ends without waiting for them.
    from starcat.pipeline.build import build
    from starcat.pipeline.specs.reading import preset

    inputs = {source: [catalogs_folder() / file] for source, file in FILES[name].items()}
    need_catalogs(*FILES[name].values())
    return build(preset(name, changes), folder, inputs=inputs, workers=1)


def fresh(*command: object, variables: Mapping[str, str] | None = None) -> str:
    """Run Python in a process of its own; return what it prints. RuntimeError if it fails."""
    run = [sys.executable, *map(str, command)]
    done = subprocess.run(
        run, capture_output=True, text=True, env=os.environ | dict(variables or {}), check=False
    )
    if done.returncode:
        said = (done.stderr.strip() or done.stdout.strip() or "nothing").split("\n")
        raise RuntimeError(f"exit {done.returncode}: {said[-1].strip()}")
    return done.stdout
