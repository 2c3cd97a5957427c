"""What docs/star.md tells of: a star, and the two builds that it went through."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from typer.testing import CliRunner

from starcat.artifact.reader import DatabaseFolder, open_artifact
from starcat.cli.main import app
from starcat.pipeline.build import Built, build_database
from starcat.specs.build_spec import BuildSpec
from starcat.specs.reading import preset
from starcat.stars.star_table import directions_of

Array = NDArray[np.float64]

STAR, NAME, PRESET = 308, "SAO 308", "sao-12deg"
LATER_JYEAR = 2026.0


def link(path: str) -> str:
    return f"[{path}](../{path})"


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    lines = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    return "\n".join(lines + [f"| {' | '.join(map(str, row))} |" for row in rows])


def wrapped(section: str) -> str:
    """Return a section with its paragraphs filled; tables, blocks and headings stay."""
    parts, in_code = [], False
    for part in section.strip().split("\n\n"):
        stays = in_code or part.startswith(("#", "|", "```", "$$", "<!--"))
        in_code ^= part.count("```") % 2 == 1
        filled = textwrap.fill(part, 100, break_long_words=False, break_on_hyphens=False)
        parts.append(part if stays else filled)
    return "\n\n".join(parts)


def cli(*arguments: object) -> list[str]:
    """Return the lines that a command prints."""
    runner = CliRunner(env={"COLUMNS": "96", "TERMINAL_WIDTH": "96"})
    done = runner.invoke(app, [str(argument) for argument in arguments], prog_name="starcat")
    if done.exit_code:
        raise RuntimeError(f"starcat {arguments[0]} failed: {done.output}")
    return [line.rstrip() for line in done.stdout.splitlines()]


def excerpt(lines: Sequence[str], beginnings: Sequence[str]) -> str:
    """Return the lines that begin so, in the order of the output."""
    return "\n".join(line for line in lines if line.startswith(tuple(beginnings)))


def arcsec(angle_rad: float) -> float:
    return float(np.degrees(angle_rad)) * 3600.0


@dataclass(frozen=True)
class Story:
    """What the build made, and the star's place in it."""

    spec: BuildSpec
    built: Built
    later: Built

    @cached_property
    def artifact(self) -> DatabaseFolder:
        return open_artifact(self.built.folder)

    @cached_property
    def tables(self) -> dict[str, pa.Table]:
        return {name: self.artifact.table(name) for name in self.artifact.products}

    @property
    def stars(self) -> pa.Table:
        return self.tables["stars"]

    @cached_property
    def row(self) -> int:
        return int(pc.index(self.stars["star_id"], STAR).as_py())

    @cached_property
    def star(self) -> dict[str, Any]:
        found: dict[str, Any] = self.stars.slice(self.row, 1).to_pylist()[0]
        return found

    @cached_property
    def directions(self) -> Array:
        return directions_of(self.stars)

    def name(self, row: int) -> str:
        return str(self.stars["designation"][int(row)])

    def rows_of(self, product: str, *columns: str) -> pa.Table:
        """The rows of a product that speak of the star in one of some columns."""
        made = self.tables[product]
        wanted = [pc.equal(made[name], self.row) for name in columns]
        keep = wanted[0]
        for other in wanted[1:]:
            keep = pc.or_(keep, other)
        return made.filter(keep)


def tell(catalogs: Path, folder: Path) -> Story:
    spec = preset(PRESET)
    inputs = {"sao": [catalogs / "sao.dat.gz"], "hipparcos": [catalogs / "hip_main.dat.gz"]}
    later = spec.model_copy(update={"version": "1.0.1", "epoch_jyear": LATER_JYEAR})
    return Story(spec, build_database(spec, inputs, folder), build_database(later, inputs, folder))
