"""The command that measures how often stars are identified."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from starcat.commands.shared import Input, Json, inputs_by_source
from starcat.errors import ConfigError

app = typer.Typer()


@app.command()
def evaluate(
    artifact: Annotated[
        Path | None, typer.Argument(help="The folder <name>-<version>; or else --paper.")
    ] = None,
    paper: Annotated[str | None, typer.Option(help="S1 to S5, or all: what they print.")] = None,
    noise: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE,...", help="What varies, as noise_px=0,1,2. Repeatable."),
    ] = None,
    method: Annotated[
        str | None, typer.Option(help="See 'starcat methods', or all; default: the best there is.")
    ] = None,
    camera: Annotated[
        Path | None, typer.Option(help="Camera file (TOML); default: the database's camera.")
    ] = None,
    frames: Annotated[
        int | None, typer.Option(min=1, help="Of each trial; default: 500, with --quick 100.")
    ] = None,
    tolerance_px: Annotated[
        float | None,
        typer.Option(min=0.01, max=200, help="Default: three times the position noise, or 1."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same frames.")] = 1,
    quick: Annotated[bool, typer.Option("--quick", help="Fewer frames.")] = False,
    inputs: Input = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder of records and reports.")
    ] = Path("dist/evaluation"),
    workers: Annotated[int, typer.Option(min=1, max=64, help="Processes.")] = 2,
    json: Json = False,
) -> None:
    """Measure how often simulated frames are identified, or reproduce the five papers.

    Finished trials are kept in the output folder and not run again. Names for --noise: noise_px,
    noise_mag, false_stars, false_share, drop_probability, k1, roll_deg, scale, limit_mag.

    Example: starcat evaluate dist/gaia-12deg-1.0.0 --noise noise_px=0,0.5,1 --frames 200
    """
    from starcat.evaluation.run import evaluate_artifact, evaluate_papers, noise_values
    from starcat.evaluation.sweep import plan_sweep
    from starcat.specs.camera_file import read_camera
    from starcat.terminal.console import progress_bars
    from starcat.terminal.evaluations import print_evaluation

    if (artifact is None) == (paper is None):
        raise ConfigError("give either an artifact or --paper")
    given = inputs_by_source(inputs)
    with progress_bars() as progress:
        if artifact is None:
            found = evaluate_papers(
                paper or "all", given, output, quick=quick, workers=workers, progress=progress
            )
        else:
            sweep = plan_sweep(
                artifact,
                noise_values(noise or []),
                method=method,
                camera=read_camera(camera) if camera else None,
                frames=frames,
                tolerance_px=tolerance_px,
                seed=seed,
                quick=quick,
            )
            found = evaluate_artifact(sweep, output, workers=workers, progress=progress)
    print_evaluation(found, as_json=json)
