"""The commands about frames: simulating, identifying, testing a database."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from starcat.commands.shared import (
    FailOnNoMatch,
    Json,
    JsonLines,
    MethodName,
    NoisePx,
    PriorAttitude,
    PriorErrorDeg,
    Track,
    WcsFile,
    chosen_prior,
)

app = typer.Typer()


@app.command()
def methods(json: Json = False) -> None:
    """List the ways to identify stars, and the products that each needs.

    Example: starcat methods
    """
    from starcat.terminal.matches import print_methods

    print_methods(as_json=json)


@app.command()
def simulate(
    artifact: Annotated[Path, typer.Argument(help="The folder <name>-<version>.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="CSV, FITS, PNG or TIFF.")],
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same frame.")] = 0,
    noise_px: NoisePx = 0.5,
    false_stars: Annotated[int, typer.Option(min=0, help="Spots that are no stars.")] = 0,
    json: Json = False,
) -> None:
    """Write one simulated frame, centroids or image, to try 'starcat identify' with.

    Example: starcat simulate dist/gaia-12deg-1.0.0 -o frame.csv --seed 7
    """
    from starcat.images.identification import write_simulated
    from starcat.matcher.database import open_database
    from starcat.simulation.simulate import Noise, simulate_frames
    from starcat.terminal.matches import print_simulated

    database = open_database(artifact)
    noise = Noise(noise_px, false_stars=false_stars)
    eye = database.camera
    frame = next(simulate_frames(database.directions, eye, 1, noise, seed, mag=database.mag))
    write_simulated(output, frame, eye, seed)
    print_simulated(frame, output, as_json=json)


@app.command()
def identify(
    artifact: Annotated[Path, typer.Argument(help="The folder <name>-<version>.")],
    file: Annotated[
        Path,
        typer.Argument(
            help="Centroids (CSV: x_px,y_px[,mag]; JSON; - for stdin) or image (FITS, PNG, TIFF)."
        ),
    ],
    method: MethodName = None,
    camera: Annotated[
        Path | None, typer.Option(help="Camera file (TOML); default: the database's camera.")
    ] = None,
    tolerance_px: Annotated[
        float | None,
        typer.Option(min=0.01, max=200, help="Largest error of a centroid; default: 2."),
    ] = None,
    noise_px: Annotated[
        float | None,
        typer.Option(min=0.01, max=50, help="Noise of a centroid, each axis; for --tolerance-px."),
    ] = None,
    noise_mag: Annotated[
        float | None,
        typer.Option(min=0.001, max=10, help="Noise of magnitudes in the database's band."),
    ] = None,
    max_false_match_probability: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Less certain answers are withheld.")
    ] = 1e-9,
    flip: Annotated[
        bool | None, typer.Option("--flip/--no-flip", help="First row of the image at the bottom.")
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(help="PNG or SVG of the first frame, its stars named.")
    ] = None,
    wcs: WcsFile = None,
    prior_q: PriorAttitude = None,
    prior_error_deg: PriorErrorDeg = None,
    track: Track = False,
    fail_on_no_match: FailOnNoMatch = False,
    ndjson: JsonLines = False,
    json: Json = False,
) -> None:
    """Identify the stars of frames and find the camera's attitude.

    Example: starcat identify dist/gaia-12deg-1.0.0 frame.csv --picture frame.png
    """
    from starcat.images.answering import answer_each, measure_input, write_extras
    from starcat.matcher.matcher import Matcher
    from starcat.matcher.tracking import Tracker
    from starcat.specs.camera_file import read_camera
    from starcat.terminal.console import say
    from starcat.terminal.matches import print_answers

    prior = chosen_prior(prior_q, prior_error_deg, track=track)
    matcher = Matcher.open(
        artifact,
        method,
        tolerance_px=tolerance_px,
        max_false_match_probability=max_false_match_probability,
        noise_px=noise_px,
        noise_mag=noise_mag,
    )
    eye = read_camera(camera) if camera else matcher.database.camera
    measured = measure_input(file, flip=flip, wcs=wcs)
    answered = answer_each(Tracker(matcher) if track else matcher, measured, eye, prior)
    told = print_answers(answered, matcher.database, as_json=json, as_lines=ndjson)
    if measured.image is not None and not told.identified:
        say("An image that was read upside down is never identified: try --flip or --no-flip.")
    if told.first is not None:
        write_extras(file, measured, *told.first, eye, picture=picture, wcs=wcs, flip=flip)
    if fail_on_no_match:
        told.expect_all_identified()


@app.command()
def selftest(
    artifact: Annotated[Path, typer.Argument(help="The folder <name>-<version>.")],
    frames: Annotated[int, typer.Option(min=1, help="Fields of each kind.")] = 500,
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same fields.")] = 1,
    noise_px: NoisePx = 0.5,
    method: MethodName = None,
    json: Json = False,
) -> None:
    """Identify simulated fields with a database and print the rates.

    Example: starcat selftest dist/gaia-12deg-1.0.0 --frames 100
    """
    from starcat.matcher.matcher import Matcher
    from starcat.simulation.selftest import self_test
    from starcat.terminal.builds import print_rates
    from starcat.terminal.console import progress_bars

    matcher = Matcher.open(artifact, method, tolerance_px=max(0.5, 4.0 * noise_px))
    with progress_bars() as progress:
        rates = self_test(matcher, frames, noise_px, seed, progress)
    print_rates(rates, as_json=json)
