"""The command that learns from identified frames."""

from __future__ import annotations

import glob
from pathlib import Path
from typing import Annotated

import typer

from starcat.cli import options as opt
from starcat.cli.console import command_line, say, show_result
from starcat.cli.outputs import Replace, expect_free, to_file
from starcat.errors import ConfigError

app = typer.Typer()


@app.command("learn")
def learn_command(
    database: Annotated[
        Path, opt.database("The database <name>-<version> used for identification.")
    ],
    results: Annotated[
        list[str],
        typer.Argument(
            metavar="RESULTS...",
            help="Output of 'starcat identify --ndjson': files, folders of *.ndjson, patterns.",
        ),
    ],
    output: Annotated[
        Path | None,
        to_file("Where the section of a spec goes, or with --patch the patch's spec (TOML)."),
    ] = None,
    patch: Annotated[
        Path | None,
        typer.Option(metavar="SPEC", help="Spec of the database: write a patch release's spec."),
    ] = None,
    stars: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Measured magnitude and residuals of each star: .csv, .parquet …"
        ),
    ] = None,
    by_frame: Annotated[
        bool,
        typer.Option("--by-frame", help="Fit an offset per frame, such as for varied exposures."),
    ] = False,
    min_frames: Annotated[
        int, typer.Option(min=2, max=1000, help="Smallest number of frames to judge a star.")
    ] = 3,
    replace: Replace = False,
    json: opt.Json = False,
) -> None:
    """Learn zero point, colour term and the stars to distrust from identified frames.

    Example: starcat learn dist/gaia-12deg-1.0.0 answers.ndjson -o observed.toml
    """
    from starcat.frames.calibration.learn import (
        content_of,
        learn,
        observed_toml,
        patch_toml,
        star_table,
    )
    from starcat.ship.exchange.formats import format_of
    from starcat.ship.exchange.writers import write_batches
    from starcat.storage.atomic import write_file

    if patch is not None and output is None:
        raise ConfigError(
            "--patch needs a name for the new spec", key="output", hint="give it with -o"
        )
    form = None if stars is None else format_of(stars)
    expect_free(output, stars, replace=replace)
    learnt = learn(database, _files_of(results), by_frame=by_frame, min_frames=min_frames)
    if output is not None:
        text = observed_toml(learnt) if patch is None else patch_toml(learnt, patch)
        write_file(output, text.encode())
    if stars is not None and form is not None:
        write_batches(star_table(learnt).to_reader(), stars, form)
    content = content_of(learnt)
    shown = {
        "": [key for key in content if key not in ("observed", "distrusted", "stars")],
        "distrusted": ("star", "verdict", "evidence"),
        "stars": (),
    }
    show_result(content, as_json=json, columns=shown)
    for path in filter(None, (output, stars)):
        say(f"written: {path}")
    if patch is not None:
        say(f"go on with: {command_line('starcat', 'build', output)}")


def _files_of(texts: list[str]) -> list[Path]:
    """Return the files that names, folders and patterns stand for."""
    files: list[Path] = []
    for text in texts:
        pattern = f"{glob.escape(text)}/*.ndjson" if Path(text).is_dir() else text
        paths = [Path(name) for name in sorted(glob.glob(pattern))]
        if not paths and Path(text).is_dir():
            raise ConfigError("no file *.ndjson is in this folder", where=text)
        files += paths or [Path(text)]
    return files
