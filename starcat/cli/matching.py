"""The commands about frames: simulating, identifying, testing a database."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from starcat.cli import options as opt
from starcat.cli.console import (
    OptionsInPanels,
    print_json,
    print_json_line,
    print_table,
    print_things,
    progress_bars,
    say,
    show,
)
from starcat.errors import ConfigError, NotIdentifiedError, words_of
from starcat.failures import option_of
from starcat.geometry.attitude import quaternion_from_matrix, radec_roll_from_matrix
from starcat.images.batch import BatchItem
from starcat.images.solve_files import FrameAnswer
from starcat.matcher.centroids import MAX_CENTROIDS
from starcat.matcher.database import Database
from starcat.matcher.result import bracketed
from starcat.onboard.flight_limits import FLIGHT_CENTROIDS, centroids_in_flight
from starcat.simulation.simulate import SimulatedFrame

if TYPE_CHECKING:
    from starcat.images.identify_options import IdentifyOptions
    from starcat.images.solve_files import FileAnswers, LocalInputs
    from starcat.matcher.matcher import Matcher

NAMED = 3  # frames that are named where some were not identified

CORRECTED = ("boresight_ra_deg", "boresight_dec_deg", "roll_deg", "q_body_from_icrs")
"""What the main table has without and with the correction for aberration."""


@dataclass
class Tally:
    """How many frames of a file there were and how many were identified, and the first answer."""

    frames: int = 0
    identified: int = 0
    first: FrameAnswer | None = None
    unidentified: list[str] = field(default_factory=list)
    files: int = 0
    unusable: list[str] = field(default_factory=list)

    def add(self, name: str, status: str) -> None:
        """Count a frame."""
        self.frames += 1
        if status == "identified":
            self.identified += 1
        elif len(self.unidentified) < NAMED:
            self.unidentified.append(f"{name}: {status}")

    def expect_all_identified(self) -> None:
        """Raise `NotIdentifiedError` unless every frame was identified."""
        missing = self.frames - self.identified
        if missing:
            more = ", ..." if missing > len(self.unidentified) else ""
            raise NotIdentifiedError(
                f"{missing:,} of {self.frames:,} frames not identified "
                f"({', '.join(self.unidentified)}{more}); 'refusal' of each says why, and what to "
                "try"
            )

    def expect_all_usable(self) -> None:
        """Raise `ConfigError` unless every file of a batch could be used."""
        if self.unusable:
            more = "; ..." if len(self.unusable) > NAMED else ""
            raise ConfigError(
                f"{len(self.unusable):,} of {self.files:,} files cannot be used: "
                f"{'; '.join(self.unusable[:NAMED])}{more}"
            )


def print_answers(
    answers: Iterable[FrameAnswer], database: Database, *, as_json: bool, as_lines: bool
) -> Tally:
    """Print the answers to the frames of a file."""
    tally, kept = Tally(), []
    for answer in answers:
        tally.first = tally.first or answer
        tally.add(answer.frame.name, answer.result.status)
        if as_lines:
            print_json_line(answer.content())
        else:
            kept.append(answer)
    if as_lines:
        return tally
    if as_json:
        print_json([answer.content() for answer in kept])
        return tally
    if len(kept) == 1:
        _print_one(kept[0].content(), database.name)
    elif kept:
        _print_many(kept, database)
    return tally


def print_batch(
    items: Iterable[BatchItem], database: Database, *, as_lines: bool
) -> tuple[Tally, list[BatchItem]]:
    """Print the answers to many files: a line of JSON each as soon as it is there, or a table."""
    tally, done, notes = Tally(), list[BatchItem](), Counter[str]()
    for item in items:
        done.append(item)
        tally.files += 1
        notes.update(item.notes)
        if item.error is not None:
            tally.unusable.append(str(item.error))
            if as_lines:
                said = {"status": "unusable", "message": str(item.error)}
                print_json_line({"file": str(item.path), "frame": item.path.stem, **said})
        for answer in item.answers:
            tally.add(answer.frame.name, answer.result.status)
            if as_lines:
                print_json_line({"file": str(item.path), **answer.content()})
    kept = [] if as_lines else [answer for item in done for answer in item.answers]
    if kept:
        _print_many(kept, database)
    for note, count in notes.items():
        say(f"{note} ({count} of {tally.files} files)")
    return tally, done


def print_contents(
    contents: Sequence[dict[str, Any]], database: str, *, as_json: bool, as_lines: bool
) -> Tally:
    """Print the answers that a service gives to the frames of a file."""
    tally = Tally()
    for one in contents:
        tally.add(one["frame"], one["status"])
        if as_lines:
            print_json_line(one)
        elif not as_json:
            _print_one(one, database)
    if as_json and not as_lines:
        print_json(list(contents))
    return tally


def _print_one(content: dict[str, Any], database: str) -> None:
    facts = {name: content[name] for name in content if name not in ("frame", "database")}
    rows = [row for name, value in facts.items() for row in _rows_of_fact(name, value)]
    reasons = Counter(star["dropped"] for star in content["stars"] if "dropped" in star)
    rows += [(f"dropped, {why.replace('_', ' ')}", count) for why, count in sorted(reasons.items())]
    print_table(f"{len(content['stars'])} centroids, {database}", ("", ""), rows)
    if content["status"] == "identified":
        _print_stars(content["stars"])
    if content.get("in_time"):
        print_sky_in_time([(content["frame"], content["in_time"])])


def _rows_of_fact(name: str, value: Any) -> list[tuple[str, Any]]:
    if name == "refusal":
        return [("because", value["words"]), ("try", as_options(value["advice"]))]
    if name == "remarks":
        return [("remark", remark) for remark in value]
    if name == "covariance_arcsec2":
        sigma = np.sqrt([_number(value[axis][axis]) for axis in range(3)])
        return [("error about x, y, z arcsec", ", ".join(f"{one:.3g}" for one in sigma))]
    if name == "q_body_from_icrs":
        return [(name, ", ".join(f"{one:+.7f}" for one in value))]
    if name == "in_time":
        given = {key: value[key] for key in CORRECTED} if value else {}
        return [
            (f"corrected {key}", told)
            for key in given
            for _, told in _rows_of_fact(key, given[key])
        ]
    if name.endswith("_deg"):
        return [(name, f"{value:.4f}")]
    if value is None or isinstance(value, list | dict):
        return []
    return [(name, f"{value:.9g}" if isinstance(value, float) else value)]


def as_options(text: str) -> str:
    """Return a text with the names of options as the command line has them.

    >>> as_options("turn the frame over (flip), or allow a larger error (fov_error)")
    'turn the frame over (--flip), or allow a larger error (--fov-error)'
    """
    return words_of(text, bracketed(text), option_of)


def _print_stars(stars: Sequence[dict[str, Any]]) -> None:
    heads = ("x px", "y px", "star", "mag", "RA deg", "Dec deg", "dx px", "dy px")
    if len(stars) > MAX_CENTROIDS:  # a terminal takes minutes to lay out tens of thousands
        stars = [star for star in stars if star["star"]]
    lines = [
        (f"{s['x_px']:.2f}", f"{s['y_px']:.2f}", s["star"],
         f"{s['mag']:.2f}", f"{s['ra_deg']:.5f}", f"{s['dec_deg']:+.5f}",
         f"{s['dx_px']:+.3f}", f"{s['dy_px']:+.3f}")
        if s["star"] else
        (f"{_shown(s['x_px'])}", f"{_shown(s['y_px'])}", "-", *5 * ("",))
        for s in stars
    ]  # fmt: skip
    print_table("Stars", heads, lines, numbers=(0, 1, 3, 4, 5, 6, 7))


def _number(value: float | None) -> float:
    return np.nan if value is None else value


def _shown(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


def _print_many(answers: Sequence[FrameAnswer], database: Database) -> None:
    rows = []
    is_tracked = any(answer.result.origin == "tracking" for answer in answers)
    for answer in answers:
        frame, result = answer.frame, answer.result
        origin = (result.origin.replace("_", " "),) if is_tracked else ()
        attitude = result if answer.sky is None else answer.sky
        angles = (attitude.boresight_ra_deg, attitude.boresight_dec_deg, attitude.roll_deg)
        why = result.refusal
        rows.append(
            (
                frame.name,
                result.status if why is None or why.reason == result.status else why.reason,
                f"{result.n_matched}/{len(frame.centroids_px)}",
                *(f"{angle:.5f}" if result.ok else "" for angle in angles),
                f"{result.residual_arcsec:.2f}" if result.ok else "",
                f"{result.false_match_probability:.1e}" if result.ok else "",
                *origin,
            )
        )
    known = [(answer.frame.name, sky.content()) for answer in answers if (sky := answer.sky)]
    ra = "corrected RA deg" if known else "RA deg"
    names = ("frame", "status", "stars", ra, "Dec deg", "roll deg", "rms arcsec", "chance")
    heads = (*names, "origin") if is_tracked else names
    counted = f"{len(answers)} frames" if len(answers) > 1 else "1 frame"
    print_table(f"{counted}, {database.name}", heads, rows, numbers=(2, 3, 4, 5, 6, 7))
    if database.image is not None:
        _say_crowded(answers)
    print_sky_in_time(known)


def _say_crowded(answers: Sequence[FrameAnswer]) -> None:
    """Say how many frames the library in flight refuses; of a single frame a remark says it."""
    counts = [len(answer.frame.centroids_px) for answer in answers]
    crowded = sum(count > FLIGHT_CENTROIDS for count in counts)
    for sentence in centroids_in_flight(max(counts)):
        say(
            f"{crowded:,} of {len(counts):,} frames have more than {FLIGHT_CENTROIDS} centroids: "
            f"{sentence}"
        )


def print_sky_in_time(known: Sequence[tuple[str, dict[str, Any]]]) -> None:
    """Print what a time adds to the answers to frames, by their names: `SkyInTime.content`."""
    if not known:
        return
    columns = {
        "frame": "{0[0]}",
        "corrected arcsec": "{0[1][correction_arcsec]:.2f}",
        "rms arcsec": "{0[1][residual_arcsec]:.2f}",
        "Sun deg": "{0[1][sun_angle_deg]:.2f}",
        "Moon deg": "{0[1][moon_angle_deg]:.2f}",
        "Earth limb deg": "{0[1][earth_limb_angle_deg]:.2f}",
    }
    title = f"With aberration, at {known[0][1]['time']}"
    print_things(title, known, columns, numbers=range(1, 6))
    bodies = [
        (name, body, "no" if body["row"] is None else "yes")
        for name, sky in known
        for body in sky["bodies"]
    ]
    if bodies:
        columns = {
            "frame": "{0[0]}",
            "body": "{0[1][name]}",
            "x px": "{0[1][x_px]:.1f}",
            "y px": "{0[1][y_px]:.1f}",
            "mag": "{0[1][mag]:.1f}",
            "from boresight deg": "{0[1][from_boresight_deg]:.2f}",
            "centroid": "{0[2]}",
        }
        print_things("Planets in the frame", bodies, columns, numbers=(2, 3, 4, 5))


def simulated_facts(frame: SimulatedFrame, output: Path) -> dict[str, Any]:
    """Return the truth about a simulated frame."""
    ra_deg, dec_deg, roll_deg = radec_roll_from_matrix(frame.matrix)
    return {
        "file": str(output),
        "centroids": len(frame.centroids_px),
        "guide_stars": frame.n_stars,
        "false_stars": int(frame.is_false.sum()),
        "boresight_ra_deg": float(ra_deg),
        "boresight_dec_deg": float(dec_deg),
        "roll_deg": float(roll_deg),
        "q_body_from_icrs": quaternion_from_matrix(frame.matrix).tolist(),
    }


app = typer.Typer()

Folder = Annotated[Path, typer.Argument(metavar="DATABASE", help="The folder <name>-<version>.")]
FrameFiles = Annotated[
    list[str],
    typer.Argument(
        metavar="INPUT...",
        help="Centroids (CSV, JSON, - for stdin), images (FITS, PNG, TIFF, JPEG, HEIC), folders of "
        "them, or patterns in quotes ('night/*.jpg').",
    ),
]
CameraFile = Annotated[
    Path | None, typer.Option(help="Camera file (TOML); default: the database's camera.")
]
TolerancePx = Annotated[
    float | None, typer.Option(min=0.01, max=200, help="Largest error of a centroid; default: 2.")
]
CentroidNoise = Annotated[
    float | None,
    typer.Option(min=0.01, max=50, help="Noise of a centroid, each axis; for --tolerance-px."),
]
MagnitudeNoise = Annotated[
    float | None,
    typer.Option(min=0.001, max=10, help="Noise of magnitudes in the database's band."),
]
Certainty = Annotated[
    float, typer.Option(min=0.0, max=1.0, help="Less certain answers are withheld.")
]
Flip = Annotated[
    bool | None, typer.Option("--flip/--no-flip", help="First row at the bottom; y upwards.")
]
Picture = Annotated[
    Path | None, typer.Option(help="PNG or SVG of the first frame, its stars named.")
]


ContactSheet = Annotated[
    Path | None,
    typer.Option(metavar="FILE.png", help="One picture of all frames, identified stars ringed."),
]


@app.command("methods")
def methods(json: opt.Json = False) -> None:
    """List the ways to identify stars, and the products that each needs.

    Example: starcat methods
    """
    from starcat.matcher.methods.table import METHODS

    rows = [
        {"method": name, "needs": list(method.products), "description": method.description}
        for name, method in METHODS.items()
    ]
    cells = [(row["method"], ", ".join(row["needs"]), row["description"]) for row in rows]
    columns = {"method": "{0[0]}", "needs": "{0[1]}", "how": "{0[2]}"}
    show(json, rows, print_things, "Methods", cells, columns)


@app.command("simulate")
def simulate_command(
    artifact: Folder,
    output: Annotated[Path, opt.to_file("Where the frame goes: CSV, FITS, PNG, TIFF, JPEG.")],
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same frame.")] = 0,
    noise_px: opt.NoisePx = 0.5,
    false_stars: Annotated[int, typer.Option(min=0, help="Centroids that are no stars.")] = 0,
    json: opt.Json = False,
) -> None:
    """Write one simulated frame, centroids or image, to try 'starcat identify' with.

    Example: starcat simulate dist/gaia-12deg-1.0.0 -o frame.csv --seed 7
    """
    from starcat.images.render import write_simulated
    from starcat.matcher.database import open_database
    from starcat.simulation.simulate import Noise, simulate_frames

    database = open_database(artifact)
    noise = Noise(noise_px, false_stars=false_stars)
    eye = database.camera
    frame = next(simulate_frames(database.directions, eye, 1, noise, seed, mag=database.mag))
    write_simulated(output, frame, eye, seed)
    told = simulated_facts(frame, output)
    if json:
        print_json(told)
        return
    say(
        f"wrote {output}: {told['centroids']} centroids, {told['guide_stars']} of guide stars; "
        f"true attitude RA {told['boresight_ra_deg']:.4f}, Dec {told['boresight_dec_deg']:+.4f}, "
        f"roll {told['roll_deg']:.4f} deg"
    )


@app.command("identify", cls=OptionsInPanels)
def identify_command(
    context: typer.Context,
    artifact: Folder,
    files: FrameFiles,
    method: opt.MethodName = None,
    camera: CameraFile = None,
    tolerance_px: TolerancePx = None,
    noise_px: CentroidNoise = None,
    noise_mag: MagnitudeNoise = None,
    max_false_match_probability: Certainty = 1e-9,
    fov_error: opt.FovError = None,
    fov: opt.FieldRange = None,
    size: opt.FrameSize = None,
    min_share: opt.MinShare = None,
    max_steps: opt.MaxSteps = None,
    time_limit_s: opt.TimeLimit = None,
    flip: Flip = None,
    psf_sigma_px: opt.PsfSigmaPx = None,
    threshold: opt.Threshold = 5.0,
    most_spots: opt.MostSpots = 200,
    plane: opt.Plane = None,
    bayer: opt.Mosaic = False,
    dark: opt.Dark = None,
    mask: opt.Mask = None,
    picture: Picture = None,
    contact_sheet: ContactSheet = None,
    time: opt.Time = None,
    velocity: opt.Velocity = None,
    orbit: opt.Orbit = None,
    wcs: opt.WcsFile = None,
    prior_q: opt.PriorAttitude = None,
    prior_error_deg: opt.PriorErrorDeg = None,
    track: opt.Track = False,
    fail_on_no_match: opt.FailOnNoMatch = False,
    ndjson: opt.JsonLines = False,
    json: opt.Json = False,
) -> None:
    """Identify the stars of frames and find the camera's attitude.

    Of several files, a folder or a pattern the answers are one table, or with --json a line of
    JSON each. The exit code is then 2 if a file cannot be used, after the answers of the others;
    otherwise 0, or 6 with --fail-on-no-match if a frame is not identified.

    Example: starcat identify dist/gaia-12deg-1.0.0 frame.csv --picture frame.png
    """
    from starcat.images.batch import files_of, is_batch

    if is_batch(files) or contact_sheet is not None:
        _check_batch(context, picture, wcs)
        tally = _identify_batch(files_of(files), artifact, context, as_lines=ndjson or json)
    elif context.obj is not None:
        from starcat.cli.remote import identify_remotely

        identify_remotely(context, artifact.name, Path(files[0]))
        return
    else:
        answers = _file_answers(Path(files[0]), artifact, context.params)
        tally = _print_file_answers(answers, picture, wcs, as_json=json, as_lines=ndjson)
    if fail_on_no_match:
        tally.expect_all_identified()


def _check_batch(context: typer.Context, picture: Path | None, wcs: Path | None) -> None:
    if context.obj is not None:
        raise ConfigError("--server takes one file at a time, and no --contact-sheet")
    for name, path in (("--picture", picture), ("--wcs", wcs)):
        if path is not None:
            raise ConfigError(
                f"{name} is for one file; of many, --contact-sheet FILE.png draws all frames"
            )


def _identify_batch(
    paths: list[Path], artifact: Path, context: typer.Context, *, as_lines: bool
) -> Tally:
    from starcat.images.batch import identify_files
    from starcat.images.overlay import check_sheet, write_contact_sheet

    sheet = context.params["contact_sheet"]
    check_sheet(sheet)
    matcher, chosen, local = _matcher_and_inputs(artifact, context.params)
    items = identify_files(paths, matcher, chosen, local)
    tally, kept = print_batch(items, matcher.database, as_lines=as_lines)
    if sheet is not None:
        write_contact_sheet(sheet, kept)
    tally.expect_all_usable()
    return tally


def _matcher_and_inputs(
    artifact: Path, given: Mapping[str, Any]
) -> tuple[Matcher, IdentifyOptions, LocalInputs]:
    from starcat.images.identify_options import IdentifyOptions
    from starcat.images.solve_files import LocalInputs, open_matcher
    from starcat.specs.camera_file import read_camera

    observer = opt.observer_of_options(given["time"], given["velocity"], given["orbit"])
    # The command line has checked what its options may be, and calls them by their own names.
    chosen = IdentifyOptions.model_construct(**opt.identify_options(given), camera=None)
    matcher, path = open_matcher(artifact, chosen), given["camera"]
    local = LocalInputs(
        camera=read_camera(path) if path else None,
        **{name: given[name] for name in ("dark", "mask", "track")},
        observer=observer,
    )
    return matcher, chosen, local


def _file_answers(file: Path, artifact: Path, given: Mapping[str, Any]) -> FileAnswers:
    from starcat.images.solve_files import identify_file

    return identify_file(file, *_matcher_and_inputs(artifact, given))


def _print_file_answers(
    answers: FileAnswers, picture: Path | None, wcs: Path | None, *, as_json: bool, as_lines: bool
) -> Tally:
    from starcat.images.image_file import expect_room_for_wcs

    if wcs is not None:
        expect_room_for_wcs(wcs, answers.path, is_picture=answers.is_image)
    database = answers.matcher.database
    tally = print_answers(answers, database, as_json=as_json, as_lines=as_lines)
    is_any = tally.identified > 0
    for note in answers.notes(tally.first, is_any_identified=is_any, flip="--flip or --no-flip"):
        say(note)
    if tally.first is not None and picture is not None:
        answers.draw(picture, tally.first)
    if tally.first is not None and wcs is not None:
        answers.write_wcs(wcs, tally.first)
    return tally


@app.command("calibrate")
def calibrate_command(
    artifact: Folder,
    files: Annotated[
        list[str], typer.Argument(metavar="FRAMES...", help="As 'starcat identify' takes them.")
    ],
    output: Annotated[Path, opt.to_file("Where the camera (TOML) goes.")],
    camera: Annotated[
        Path | None, typer.Option(help="Camera file to start from; default: the database's camera.")
    ] = None,
    size: Annotated[
        str | None, typer.Option(metavar="WxH", help="Pixels, such as 1280x960, in its place.")
    ] = None,
    fov: opt.FieldRange = None,
    method: opt.MethodName = None,
    flip: Annotated[
        bool | None, typer.Option("--flip/--no-flip", help="First row of the image at the bottom.")
    ] = None,
    plot: Annotated[Path | None, typer.Option(help="PNG or SVG of the residuals.")] = None,
    earth_rotation: Annotated[
        bool,
        typer.Option(
            "--earth-rotation",
            help="The camera stood on the ground: the turn of the Earth tells errors of attitude.",
        ),
    ] = False,
    times: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.csv",
            help="Columns frame and time (UTC), where pictures do not say when they were taken.",
        ),
    ] = None,
    json: opt.Json = False,
) -> None:
    """Find focal length, principal point and distortion of a camera from frames of stars.

    Example: starcat calibrate dist/gaia-12deg-1.0.0 frames.json -o camera.toml --plot left.svg
    """
    from starcat.calibration.earth_rotation import earth_rotation as turned_by
    from starcat.calibration.earth_rotation import times_of_frames
    from starcat.calibration.files import calibrate_files, draw_residuals, write_camera
    from starcat.cli.learning import print_calibration
    from starcat.images.batch import frame_files
    from starcat.images.overlay import check_kind
    from starcat.matcher.matcher import Matcher
    from starcat.specs.camera_file import read_camera

    check_kind(plot)
    paths = frame_files(files)
    when = times_of_frames(paths, times) if earth_rotation or times else None
    known = read_camera(camera) if camera else None
    size_px, fov_deg = None if size is None else opt.size_in_px(size), opt.field_range(fov)
    with progress_bars() as progress:
        found = calibrate_files(
            Matcher.open(artifact, method), paths, camera=known, size_px=size_px, fov_deg=fov_deg,
            flip=flip, progress=progress,
        )  # fmt: skip
    write_camera(found, output)
    if plot:
        draw_residuals(found, plot)
    print_calibration(found, output, turned_by(found, when) if when else None, as_json=json)


@app.command("selftest")
def selftest(
    artifact: Folder,
    frames: Annotated[int, typer.Option(min=1, help="Fields of each kind.")] = 500,
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same fields.")] = 1,
    noise_px: opt.NoisePx = 0.5,
    method: opt.MethodName = None,
    json: opt.Json = False,
) -> None:
    """Identify simulated fields with a database and print the rates.

    Example: starcat selftest dist/gaia-12deg-1.0.0 --frames 100
    """
    from starcat.cli.builds import print_rates
    from starcat.matcher.matcher import Matcher
    from starcat.simulation.selftest import self_test

    matcher = Matcher.open(artifact, method, tolerance_px=max(0.5, 4.0 * noise_px))
    with progress_bars() as progress:
        rates = self_test(matcher, frames, noise_px, seed, progress)
    show(json, [rate.as_dict() for rate in rates], print_rates, rates)
