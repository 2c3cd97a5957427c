"""The commands about frames: simulating, identifying, testing a database."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from starcat.cli.commands.expected import PriorAttitude, PriorErrorDeg, Track, chosen_prior
from starcat.cli.commands.shared import (
    Dark,
    FailOnNoMatch,
    FieldRange,
    FovError,
    FrameSize,
    Json,
    JsonLines,
    Mask,
    MaxSteps,
    MethodName,
    MinShare,
    Mosaic,
    MostSpots,
    NoisePx,
    Orbit,
    Plane,
    PsfSigmaPx,
    Threshold,
    Time,
    TimeLimit,
    Velocity,
    WcsFile,
    field_range,
    limits_of_options,
    observer_of_options,
    share_of_percent,
    size_in_px,
    unknown_field,
)

app = typer.Typer()


@app.command()
def methods(json: Json = False) -> None:
    """List the ways to identify stars, and the products that each needs.

    Example: starcat methods
    """
    from starcat.cli.terminal.matches import print_methods

    print_methods(as_json=json)


@app.command()
def simulate(
    artifact: Annotated[Path, typer.Argument(help="The folder <name>-<version>.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="CSV, FITS, PNG, TIFF, JPEG.")],
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same frame.")] = 0,
    noise_px: NoisePx = 0.5,
    false_stars: Annotated[int, typer.Option(min=0, help="Spots that are no stars.")] = 0,
    json: Json = False,
) -> None:
    """Write one simulated frame, centroids or image, to try 'starcat identify' with.

    Example: starcat simulate dist/gaia-12deg-1.0.0 -o frame.csv --seed 7
    """
    from starcat.cli.terminal.matches import print_simulated
    from starcat.images.identification import write_simulated
    from starcat.matcher.database import open_database
    from starcat.simulation.simulate import Noise, simulate_frames

    database = open_database(artifact)
    noise = Noise(noise_px, false_stars=false_stars)
    eye = database.camera
    frame = next(simulate_frames(database.directions, eye, 1, noise, seed, mag=database.mag))
    write_simulated(output, frame, eye, seed)
    print_simulated(frame, output, as_json=json)


@app.command()
def identify(
    context: typer.Context,
    artifact: Annotated[Path, typer.Argument(help="The folder <name>-<version>.")],
    file: Annotated[
        Path,
        typer.Argument(help="Centroids (CSV, JSON, - for stdin) or image (FITS, PNG, TIFF, JPEG)."),
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
    fov_error: FovError = None,
    fov: FieldRange = None,
    size: FrameSize = None,
    min_share: MinShare = None,
    max_steps: MaxSteps = None,
    time_limit_s: TimeLimit = None,
    flip: Annotated[
        bool | None, typer.Option("--flip/--no-flip", help="First row at the bottom; y upwards.")
    ] = None,
    psf_sigma_px: PsfSigmaPx = None,
    threshold: Threshold = 5.0,
    most_spots: MostSpots = 200,
    plane: Plane = None,
    bayer: Mosaic = False,
    dark: Dark = None,
    mask: Mask = None,
    picture: Annotated[
        Path | None, typer.Option(help="PNG or SVG of the first frame, its stars named.")
    ] = None,
    time: Time = None,
    velocity: Velocity = None,
    orbit: Orbit = None,
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
    if context.obj is not None:
        from starcat.cli.commands.there import identify_there

        identify_there(context, artifact.name, file)
        return
    from starcat.cli.terminal.console import say
    from starcat.cli.terminal.matches import print_answers
    from starcat.images.answering import answer_each, camera_of_size, measure_input, write_extras
    from starcat.images.identification import PictureOptions
    from starcat.matcher.centroids import said_of_columns
    from starcat.matcher.matcher import Matcher
    from starcat.matcher.tracking import Tracker
    from starcat.specs.camera_file import read_camera

    prior = chosen_prior(prior_q, prior_error_deg, track=track)
    observer = observer_of_options(time, velocity, orbit)
    matcher = Matcher.open(
        artifact,
        method,
        tolerance_px=tolerance_px,
        max_false_match_probability=max_false_match_probability,
        noise_px=noise_px,
        noise_mag=noise_mag,
        **limits_of_options(min_share, max_steps, time_limit_s),
    )
    eye = read_camera(camera) if camera else matcher.database.camera
    how = PictureOptions(threshold, psf_sigma_px, most_spots, plane, bayer, dark, mask)
    measured = measure_input(file, flip=flip, wcs=wcs, options=how)
    error, (size_px, fov_deg) = share_of_percent(fov_error), unknown_field(size, fov, fov_error)
    if fov_deg is not None:
        eye = camera_of_size(measured, size_px, eye)
    near = Tracker(matcher) if track else prior
    answered = answer_each(
        *(matcher, measured, eye, observer), flip=flip, fov_error=error, near=near, fov_deg=fov_deg
    )
    told = print_answers(
        answered, matcher.database, as_json=json, as_lines=ndjson, observer=observer
    )
    if told.first and (unknown := said_of_columns([told.first[0]])):
        say(unknown)
    if measured.image is not None and not told.identified:
        say("An image that was read upside down is never identified: try --flip or --no-flip.")
    if told.first is not None:
        write_extras(
            file, measured, *told.first, eye, picture=picture, wcs=wcs, flip=flip, observer=observer
        )
    if fail_on_no_match:
        told.expect_all_identified()


@app.command()
def calibrate(
    artifact: Annotated[Path, typer.Argument(help="The folder <name>-<version>.")],
    files: Annotated[
        list[Path], typer.Argument(metavar="FRAMES...", help="As 'starcat identify' takes them.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Camera file (TOML) to write.")],
    camera: Annotated[
        Path | None, typer.Option(help="Camera file to start from; default: the database's camera.")
    ] = None,
    size: Annotated[
        str | None, typer.Option(metavar="WxH", help="Pixels, such as 1280x960, in its place.")
    ] = None,
    fov: FieldRange = None,
    method: MethodName = None,
    flip: Annotated[
        bool | None, typer.Option("--flip/--no-flip", help="First row of the image at the bottom.")
    ] = None,
    plot: Annotated[Path | None, typer.Option(help="PNG or SVG of the residuals.")] = None,
    json: Json = False,
) -> None:
    """Find focal length, principal point and distortion of a camera from frames of stars.

    Example: starcat calibrate dist/gaia-12deg-1.0.0 frames.json -o camera.toml --plot left.svg
    """
    from starcat.calibration.camera_text import write_camera
    from starcat.calibration.files import calibrate_files
    from starcat.calibration.residual_plot import checked_kind, draw_residuals
    from starcat.cli.terminal.calibrations import print_calibration
    from starcat.cli.terminal.console import progress_bars
    from starcat.matcher.matcher import Matcher
    from starcat.specs.camera_file import read_camera

    checked_kind(plot)
    known = read_camera(camera) if camera else None
    size_px, fov_deg = size_in_px(size), field_range(fov)
    with progress_bars() as progress:
        found = calibrate_files(
            Matcher.open(artifact, method), files, camera=known, size_px=size_px, fov_deg=fov_deg,
            flip=flip, progress=progress,
        )  # fmt: skip
    write_camera(found, output)
    if plot:
        draw_residuals(found, plot)
    print_calibration(found, output, as_json=json)


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
    from starcat.cli.terminal.builds import print_rates
    from starcat.cli.terminal.console import progress_bars
    from starcat.matcher.matcher import Matcher
    from starcat.simulation.selftest import self_test

    matcher = Matcher.open(artifact, method, tolerance_px=max(0.5, 4.0 * noise_px))
    with progress_bars() as progress:
        rates = self_test(matcher, frames, noise_px, seed, progress)
    print_rates(rates, as_json=json)
