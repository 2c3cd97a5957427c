"""The commands about frames: simulating, identifying, testing a database."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from starcat.cli import options as opt
from starcat.cli.console import OptionsInPanels, print_json, progress_bars, say, show, show_result
from starcat.cli.outputs import Replace, expect_free, expect_room, to_file
from starcat.errors import ConfigError, count_of
from starcat.matcher.options import IdentifyOptions, SimulationOptions

if TYPE_CHECKING:
    from starcat.cli.matches import Tally
    from starcat.frames.images.measure import LocalInputs
    from starcat.frames.images.solve_files import FileAnswers
    from starcat.geometry.camera import Camera
    from starcat.matcher.matcher import Matcher

app = typer.Typer()

Folder = Annotated[Path, opt.database()]
FolderOrImage = Annotated[
    Path, opt.database("The folder <name>-<version>, or an onboard image.", or_image=True)
]
FrameFiles = Annotated[
    list[str],
    typer.Argument(
        metavar="INPUT...",
        help="Centroids (CSV, JSON, tables of FITS and other formats, - for stdin), images (FITS, "
        "PNG, TIFF, JPEG, HEIC, BMP, raw), folders of them, or patterns in quotes "
        "('night/*.jpg').",
    ),
]
CameraFile = Annotated[
    Path | None,
    typer.Option(
        rich_help_panel="Camera", help="Camera file (TOML); default: the database's camera."
    ),
]
Picture = Annotated[
    Path | None, typer.Option(help="PNG or SVG of the first frame with the stars' names.")
]


ContactSheet = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE.png", help="One picture of all frames, with identified stars ringed."
    ),
]


@app.command("methods")
def methods(json: opt.Json = False) -> None:
    """List the methods of identification, and the products that each needs.

    Example: starcat methods
    """
    from starcat.matcher.methods.table import METHODS

    rows = [
        {"method": name, "needs": list(method.products), "description": method.description}
        for name, method in METHODS.items()
    ]
    show_result(rows, as_json=json)


def simulate_command(
    database: Folder,
    output: Annotated[Path, to_file("Where the frame goes: CSV, FITS, PNG, TIFF, JPEG.")],
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same frame.")] = 0,
    false_stars: Annotated[int, typer.Option(min=0, help="Centroids that are not stars.")] = 0,
    replace: Replace = False,
    json: opt.Json = False,
    **options: Any,
) -> None:
    """Write one simulated frame (centroids or an image) for trying 'starcat identify'.

    Example: starcat simulate dist/gaia-12deg-1.0.0 -o frame.csv --seed 7
    """
    from starcat.cli.matches import simulated_facts
    from starcat.frames.images.render import write_simulated
    from starcat.matcher.database import open_database
    from starcat.pipeline.simulation.simulate import simulate

    expect_free(output, replace=replace)
    opened = open_database(database)
    [frame] = simulate(opened, false_stars=false_stars, seed=seed, **options)
    write_simulated(output, frame, opened.camera, seed)
    facts = simulated_facts(frame, output)
    if json:
        print_json(facts)
        return
    count = count_of(facts["centroids"], "centroid")
    say(
        f"wrote {output}: {count}, {facts['guide_stars']} of guide stars; "
        f"true attitude RA {facts['boresight_ra_deg']:.4f}, Dec {facts['boresight_dec_deg']:+.4f}, "
        f"roll {facts['roll_deg']:.4f} deg"
    )


opt.takes(simulate_command, SimulationOptions)
app.command("simulate")(simulate_command)


def identify_command(
    context: typer.Context,
    database: FolderOrImage,
    files: FrameFiles,
    camera: CameraFile = None,
    dark: opt.Dark = None,
    mask: opt.Mask = None,
    velocity: opt.Velocity = None,
    orbit: opt.Orbit = None,
    track: opt.Track = False,
    picture: Picture = None,
    contact_sheet: ContactSheet = None,
    wcs: opt.WcsFile = None,
    fail_on_no_match: opt.FailOnNoMatch = False,
    ndjson: opt.JsonLines = False,
    json: opt.Json = False,
    **options: Any,
) -> None:
    """Identify the stars of frames and find the camera's attitude.

    With several files, a folder or a pattern the answers are one table, or with --json one line of
    JSON each. If a file cannot be used, the others are still answered and the exit code is 2.
    Otherwise it is 0, or 6 with --fail-on-no-match if a frame is not identified.

    Example: starcat identify dist/gaia-12deg-1.0.0 frame.csv --picture frame.png
    """
    from starcat.frames.images.batch import files_of, is_batch
    from starcat.frames.images.contact_sheet import check_sheet
    from starcat.frames.images.image_file import check_wcs_name
    from starcat.frames.images.solve_files import answer_file
    from starcat.storage.figures import check_kind

    check_kind(picture, "picture")
    check_sheet(contact_sheet)
    check_wcs_name(wcs)
    expect_room(picture=picture, contact_sheet=contact_sheet, wcs=wcs)
    if is_batch(files) or contact_sheet is not None:
        _check_batch(context, picture, wcs)
        tally = _identify_batch(files_of(files), database, context, as_lines=ndjson or json)
    elif context.obj is not None:
        from starcat.cli.remote import identify_remotely

        identify_remotely(context, database.name, Path(files[0]))
        return
    else:
        answers = answer_file(Path(files[0]), *_matcher_and_inputs(database, context.params))
        tally = _print_file_answers(answers, picture, wcs, as_json=json, as_lines=ndjson)
    if fail_on_no_match:
        tally.expect_all_identified()


opt.takes(identify_command, IdentifyOptions)
app.command("identify", cls=OptionsInPanels)(identify_command)


def _check_batch(context: typer.Context, picture: Path | None, wcs: Path | None) -> None:
    if context.obj is not None:
        raise ConfigError("--server takes one file at a time, and no --contact-sheet")
    for name, path in (("--picture", picture), ("--wcs", wcs)):
        if path is not None:
            raise ConfigError(
                f"{name} is for one file",
                hint="for several, --contact-sheet FILE.png draws all frames",
            )


def _identify_batch(
    paths: list[Path], database: Path, context: typer.Context, *, as_lines: bool
) -> Tally:
    from starcat.cli.matches import print_batch
    from starcat.frames.images.batch import identify_files
    from starcat.frames.images.contact_sheet import write_contact_sheet

    sheet = context.params["contact_sheet"]
    matcher, options, local = _matcher_and_inputs(database, context.params)
    items = identify_files(paths, matcher, options, local)
    tally, kept = print_batch(items, matcher.database, as_lines=as_lines)
    if sheet is not None:
        write_contact_sheet(sheet, kept)
    tally.expect_all_usable()
    return tally


def _matcher_and_inputs(
    database: Path, parameters: Mapping[str, Any]
) -> tuple[Matcher, IdentifyOptions, LocalInputs]:
    from starcat.frames.images.measure import LocalInputs
    from starcat.frames.images.solve_files import open_matcher

    observer = opt.observer_of_options(
        parameters["time"], parameters["velocity"], parameters["orbit"]
    )
    options = opt.options_of_line(parameters)
    matcher, path = open_matcher(database, options), parameters["camera"]
    local = LocalInputs(
        camera=_camera_of(path),
        **{name: parameters[name] for name in ("dark", "mask", "track")},
        observer=observer,
    )
    return matcher, options, local


def _camera_of(path: Path | None) -> Camera | None:
    """Return the camera of a file; the import of what reads it takes longer than a frame."""
    if path is None:
        return None
    from starcat.pipeline.specs.camera_file import read_camera

    return read_camera(path)


def _print_file_answers(
    answers: FileAnswers, picture: Path | None, wcs: Path | None, *, as_json: bool, as_lines: bool
) -> Tally:
    from starcat.cli.matches import print_answers

    if wcs is not None:
        answers.expect_picture(wcs)
    database = answers.matcher.database
    tally = print_answers(answers, database, as_json=as_json, as_lines=as_lines)
    for note in answers.notes(tally.first):
        say(note)
    if tally.first is not None and picture is not None:
        answers.draw(picture, tally.first)
    if tally.first is not None and wcs is not None:
        answers.write_wcs(wcs, tally.first)
    return tally


@app.command("calibrate")
def calibrate_command(
    database: FolderOrImage,
    files: Annotated[
        list[str], typer.Argument(metavar="FRAMES...", help="Frames, as for 'starcat identify'.")
    ],
    output: Annotated[Path, to_file("Where the camera (TOML) goes.")],
    camera: Annotated[
        Path | None, typer.Option(help="Camera file to start from; default: the database's camera.")
    ] = None,
    size: Annotated[
        str | None, typer.Option(metavar="WxH", help="Size instead of a camera, such as 1280x960.")
    ] = None,
    fov: opt.FieldRange = None,
    method: opt.MethodName = None,
    flip: opt.Flip = None,
    plot: Annotated[Path | None, typer.Option(help="PNG or SVG of the residuals.")] = None,
    earth_rotation: Annotated[
        bool,
        typer.Option(
            "--earth-rotation",
            help="The camera stood on the ground: the Earth's rotation shows attitude errors.",
        ),
    ] = False,
    times: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.csv",
            help="Table of frame and time (UTC), if the pictures do not state their times.",
        ),
    ] = None,
    replace: Replace = False,
    json: opt.Json = False,
) -> None:
    """Find focal length, principal point and distortion of a camera from frames of stars.

    Example: starcat calibrate dist/gaia-12deg-1.0.0 frames.json -o camera.toml --plot left.svg
    """
    from starcat.cli.calibrations import print_calibration
    from starcat.frames.calibration.earth_rotation import earth_rotation as turned_by
    from starcat.frames.calibration.earth_rotation import times_of_frames
    from starcat.frames.calibration.files import calibrate, draw_residuals, write_camera
    from starcat.frames.images.batch import frame_files
    from starcat.matcher.option_texts import field_range, size_in_px
    from starcat.pipeline.specs.camera_file import read_camera
    from starcat.storage.figures import check_kind

    check_kind(plot)
    expect_room(plot=plot)
    expect_free(output, plot, replace=replace)
    paths = frame_files(files)
    when = times_of_frames(paths, times) if earth_rotation or times else None
    start_camera = read_camera(camera) if camera else None
    size_px = None if size is None else size_in_px(size)
    fov_deg = None if fov is None else field_range(fov)
    with progress_bars() as progress:
        calibration = calibrate(
            database, paths, camera=start_camera, size_px=size_px, fov_deg=fov_deg, method=method,
            flip=flip, progress=progress,
        )  # fmt: skip
    write_camera(calibration, output)
    if plot:
        draw_residuals(calibration, plot)
    print_calibration(
        calibration, output, turned_by(calibration, when) if when else None, as_json=json
    )


def selftest(
    database: FolderOrImage,
    frames: Annotated[int, typer.Option(min=1, help="Number of fields of each kind.")] = 500,
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same fields.")] = 1,
    method: opt.MethodName = None,
    json: opt.Json = False,
    **options: Any,
) -> None:
    """Identify simulated fields with a database and print the rates.

    Example: starcat selftest dist/gaia-12deg-1.0.0 --frames 100
    """
    from starcat.cli.builds import print_rates
    from starcat.matcher.matcher import Matcher
    from starcat.pipeline.simulation.selftest import self_test
    from starcat.pipeline.simulation.simulate import part_of_database

    noise_px: float = options["noise_px"]
    matcher = Matcher.open(database, method, tolerance_px=max(0.5, 4.0 * noise_px))
    part = part_of_database(matcher.database.folder)
    with progress_bars() as progress:
        rates = self_test(matcher, frames, noise_px, seed, progress, part=part)
    show(json, [rate.as_dict() for rate in rates], print_rates, rates)


opt.takes(selftest, SimulationOptions, "noise_px")
app.command("selftest")(selftest)
