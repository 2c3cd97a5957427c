"""Options that several commands share, and how their texts become inputs."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from starcat.errors import ConfigError
from starcat.failures import option_of
from starcat.matcher.options import OPTIONS, SIMULATED, Option

if TYPE_CHECKING:
    from starcat.sky.observer import Observer
    from starcat.specs.build_spec import BuildSpec, CameraSpec


def database(
    what: str = "The folder <name>-<version>.", *, or_image: bool = False, name: str = "DATABASE"
) -> Any:
    """Return the argument for a command that opens a database (or also an onboard image)."""

    def check(path: Path | None) -> Path | None:
        if path is not None and path.is_file() and not (or_image and path.suffix == ".img"):
            _refuse_other_files(path)
        return path

    return typer.Argument(metavar=name, callback=check, help=what)


def _refuse_other_files(path: Path) -> None:
    from starcat.images.batch import CENTROID_SUFFIXES
    from starcat.images.solve_files import IMAGE_SUFFIXES
    from starcat.storage.file_formats import RAW_MAKERS

    kinds = {
        "a picture": (*IMAGE_SUFFIXES, *RAW_MAKERS),
        "a file of centroids": CENTROID_SUFFIXES,
        "a file of answers": (".ndjson",),
        "a spec or a camera": (".toml",),
        "an onboard image": (".img",),
    }
    for kind, suffixes in kinds.items():
        if path.suffix.lower() in suffixes:
            raise ConfigError(
                f"{path} is {kind}; the database comes first: the folder <name>-<version> that "
                "'starcat build' made"
            )


def option(
    name: str,
    *flags: str,
    metavar: str | None = None,
    description: str | None = None,
    options: Mapping[str, Option] = OPTIONS,
) -> Any:
    """Return the option for a parameter of an identification, with its range and description."""
    known, low, high = options[name]
    others = [other for other in options if "_" in other]
    return typer.Option(
        *flags,
        metavar=metavar,
        min=low if low > -math.inf else None,
        max=high if high < math.inf else None,
        help=description or with_options(known, {one: option_of(one) for one in others}),
    )


def with_options(text: str, options: Mapping[str, str]) -> str:
    """Return a description in which the names of parameters are options.

    Examples
    --------
    >>> with_options("Instead of tolerance_px.", {"tolerance_px": "--tolerance-px"})
    'Instead of --tolerance-px.'
    """
    for name, option_name in options.items():
        text = text.replace(name, option_name)
    return text


Json = Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")]
Input = Annotated[
    list[str] | None,
    typer.Option(
        "--input",
        metavar="SOURCE=PATH",
        help="File, folder or address (HATS) of a source. Repeatable.",
    ),
]
OwnSources = Annotated[
    list[Path] | None,
    typer.Option(
        "--source", metavar="MAP.toml",
        help="Map of a table of your own, which makes it a source. Repeatable.",
    ),
]  # fmt: skip
SpecFile = Annotated[Path | None, typer.Argument(help="A build spec (TOML).")]
PresetName = Annotated[str | None, typer.Option(help="A spec that ships with starcat.")]
Changes = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="A key of the spec, such as camera.fov_x_deg=16. Repeatable.",
    ),
]
MethodName = Annotated[str | None, option("method")]
Workers = Annotated[
    int, typer.Option(min=1, max=1024, help="Processes or threads; the result is the same.")
]
Scheduler = Annotated[
    str | None,
    typer.Option(metavar="tcp://HOST:PORT", help="A Dask cluster to use instead of this machine."),
]
FieldRange = Annotated[
    str | None,
    typer.Option(metavar="LOW:HIGH", help="Range of the horizontal field of view, degrees."),
]
Field = Annotated[str | None, option("fov_deg", "--fov", metavar="DEG|LOW:HIGH")]
Time = Annotated[str | None, option("time", metavar="UTC")]
Velocity = Annotated[
    str | None,
    typer.Option(metavar="VX,VY,VZ", help="Relative to the Earth, km/s, GCRS; with --time."),
]
Orbit = Annotated[
    str | None,
    typer.Option(metavar="X,Y,Z,VX,VY,VZ", help="Position too (km); instead of --velocity."),
]
FrameSize = Annotated[str | None, option("size_px", "--size", metavar="WxH")]
TolerancePx = Annotated[float | None, option("tolerance_px")]
CentroidNoise = Annotated[float | None, option("noise_px")]
MagnitudeNoise = Annotated[float | None, option("noise_mag")]
Certainty = Annotated[float, option("max_false_match_probability")]
Flip = Annotated[bool | None, option("flip", "--flip/--no-flip")]
MinShare = Annotated[float | None, option("min_share")]
CameraError = Annotated[float | None, option("camera_error")]
MaxSteps = Annotated[int | None, option("max_steps")]
TimeLimit = Annotated[float | None, option("time_limit_s", "--time-limit-s", "--time-limit")]
PsfSigmaPx = Annotated[float | None, option("psf_sigma_px")]
Threshold = Annotated[float, option("threshold")]
MostSpots = Annotated[int, option("most_spots")]
Plane = Annotated[int | None, option("plane")]
Mosaic = Annotated[bool, option("bayer", "--bayer")]
FovError = Annotated[  # a text because of the percent sign
    str | None, typer.Option(metavar="2%", help=OPTIONS["fov_error"].description)
]
Dark = Annotated[Path | None, typer.Option(help="Image with the lid on; it is subtracted.")]
Mask = Annotated[
    Path | None, typer.Option(help="Mask image: pixels that are not zero (dead, hot) are ignored.")
]
SimulatedNoisePx = Annotated[float, option("noise_px", options=SIMULATED)]
SimulatedNoiseMag = Annotated[float, option("noise_mag", options=SIMULATED)]

JsonLines = Annotated[
    bool, typer.Option("--ndjson", help="One line of JSON per frame, as soon as it is done.")
]
FailOnNoMatch = Annotated[
    bool,
    typer.Option("--fail-on-no-match", help="End with code 6 unless all frames are identified."),
]
WcsFile = Annotated[
    Path | None, typer.Option(help="FITS copy of the image with the WCS that was found.")
]


def chosen_spec(path: Path | None, name: str | None, changes: list[str] | None = None) -> BuildSpec:
    """Return the spec of a file or of a preset."""
    from starcat.specs.reading import local_preset, preset_names, read_spec

    if path is not None and name is not None:
        raise ConfigError("give either a spec file or --preset, not both")
    if path is not None:
        return read_spec(path, changed_keys(changes))
    if name is None:
        raise ConfigError(
            "say what to build: a spec (TOML), or --preset with one of " + ", ".join(preset_names())
        )
    return local_preset(name, changed_keys(changes))


def changed_keys(given: list[str] | None) -> dict[str, str]:
    """Return the values of ``KEY=VALUE`` texts by key."""
    changes = {}
    for text in given or []:
        key, separator, value = text.partition("=")
        if not separator or not key.strip():
            raise ConfigError(f"--set {text!r} is not KEY=VALUE, such as camera.fov_x_deg=16")
        changes[key.strip()] = value.strip()
    return changes


def camera_of_options(
    size: str,
    focal_mm: float | None,
    pixel_um: str | None,
    fov_x_deg: float | None,
    fov_y_deg: float | None = None,
) -> CameraSpec:
    """Return the camera that the options of a command line describe.

    ``pixel_um`` is a number as text, or what someone writes for two sides, which is refused.
    """
    from pydantic import ValidationError

    from starcat.specs.build_spec import CameraSpec
    from starcat.storage.toml_files import what_is_wrong

    width_px, height_px = size_in_px(size)
    content = {
        "width_px": width_px,
        "height_px": height_px,
        "focal_length_mm": focal_mm,
        "pixel_um": pixel_um,
        "fov_x_deg": fov_x_deg,
        "fov_y_deg": fov_y_deg,
    }
    if pixel_um is not None:
        with suppress(ValueError):
            content["pixel_um"] = float(pixel_um)
    try:
        return CameraSpec.model_validate(
            {key: value for key, value in content.items() if value is not None}
        )
    except ValidationError as error:
        text = (
            str(what_is_wrong(error, "camera", CameraSpec, "camera"))
            .removeprefix("camera: ")
            .removeprefix("spec: ")
        )
        raise ConfigError(with_options(text, CAMERA_OPTIONS)) from error


CAMERA_OPTIONS = {
    "width_px": "--size WIDTH",
    "height_px": "--size HEIGHT",
    "focal_length_mm": "--focal-mm",
    "pixel_um": "--pixel-um",
    "fov_x_deg": "--fov-x-deg",
    "fov_y_deg": "--fov-y-deg",
}
"""Option by key of the spec."""


def size_in_px(text: str) -> tuple[int, int]:
    """Return the width and height of a ``--size``."""
    found = re.fullmatch(r"([0-9]{1,6})\s*[xX]\s*([0-9]{1,6})", text.strip())
    if found is None:
        raise ConfigError(f"--size {text!r} is not WIDTHxHEIGHT in pixels, such as 1280x960")
    return int(found[1]), int(found[2])


def field_range(
    text: str | None, option: str = "--fov", *, may_be_one: bool = False
) -> tuple[float, float] | None:
    """Return the smallest and largest field of an option; both are equal for a single field."""
    if text is None:
        return None
    low, separator, high = text.partition(":")
    try:
        about, widest = float(low), float(high) if separator else None
    except ValueError:
        one = "neither a field of view, such as 12, nor a range, such as 5:20"
        raise ConfigError(
            f"{option} {text!r} is {one if may_be_one else 'not a range LOW:HIGH, such as 5:20'}; "
            "write degrees, without a unit"
        ) from None
    if widest is not None:
        is_range = about < widest or (about == widest and option == "--fov")
        if is_range and about > 0.0 and widest < 180.0:
            return about, widest
        order = f"; write {option} {widest:g}:{about:g}" if 0.0 < widest < about < 180.0 else ""
        raise ConfigError(
            f"{option} is {text}; expected two fields of view between 0 and 180 deg, the narrower "
            f"one first{order}"
        )
    if may_be_one:
        if 0.0 < about < 180.0:
            return about, about
        raise ConfigError(f"{option} is {text}; expected a field of view between 0 and 180 deg")
    raise ConfigError(
        f"{option} {text!r} is a single field of view; write a range, such as "
        f"{option} {0.8 * about:g}:{1.25 * about:g}, or state one field with "
        f"{'--fov-x-deg' if option == '--fov-range' else '--camera'}"
    )


def inputs_by_source(
    given: list[str] | None, only: str | None = None, maps: list[Path] | None = None
) -> Mapping[str, list[Path]]:
    """Return the paths of ``SOURCE=PATH`` texts by source, after adding the sources of maps."""
    from starcat.catalog.source import give_map, source_given
    from starcat.storage.download import is_address
    from starcat.store.wire import input_path

    for own in maps or []:
        give_map(own)
    inputs: dict[str, list[Path]] = {}
    for text in given or []:
        name, separator, path = text.partition("=")
        if only is not None and (name != only or not separator):
            name, separator, path = only, "=", text
        if not separator or not path:
            raise ConfigError(f"--input {text!r} is not SOURCE=PATH, such as sao=sao.dat.gz")
        source = source_given(name)
        if source.kind != "stars" and is_address(path, "input"):
            raise ConfigError(
                f"--input {text!r}: {source.name} is read from a file; bring it here with "
                f"'starcat fetch {source.name}'",
                hint="At an address HATS catalogs of stars are read",
            )
        inputs.setdefault(source.name, []).append(input_path(path))
    return inputs


def unknown_field(
    size: str | None, fov: str | None, fov_error: str | None
) -> tuple[tuple[int, int] | None, tuple[float, float] | None]:
    """Return the options for frames whose field of view is unknown."""
    fields = field_range(fov, may_be_one=True)
    if fields is not None and fields[0] != fields[1] and fov_error is not None:
        raise ConfigError("give either --fov, a range of fields, or --fov-error, not both")
    if size is not None and fov is None:
        raise ConfigError("--size needs --fov; for other frames state the size with --camera")
    return None if size is None else size_in_px(size), fields


def share_of_percent(text: str | None) -> float | None:
    """Return the number that a share stands for.

    Examples
    --------
    >>> share_of_percent("2%"), share_of_percent("0.1")
    (0.02, 0.1)
    """
    if text is None:
        return None
    number, percent, rest = text.strip().partition("%")
    try:
        share = float(number) / (100.0 if percent else 1.0)
        if not rest and OPTIONS["fov_error"].low <= share <= OPTIONS["fov_error"].high:
            return share
    except ValueError:
        pass
    raise ConfigError(
        f"--fov-error is {text!r}; expected a share from 0 to 50 %, such as 2% or 0.02",
        key="fov_error",
        value=text,
    )


def observer_of_options(
    time: str | None, velocity: str | None, orbit: str | None
) -> Observer | None:
    """Return the observer that the options of a command line describe."""
    if time is None:
        if velocity is not None or orbit is not None:
            word = "--velocity" if velocity is not None else "--orbit"
            raise ConfigError(f"{word} needs --time, the time at which it is valid")
        return None
    from starcat.sky.observer import Observer, observer_numbers

    if orbit is not None:
        if velocity is not None:
            raise ConfigError("give either --velocity or --orbit, which holds the velocity too")
        state = observer_numbers("--orbit", orbit, 6)
        return Observer.at(time, position_km=state[:3], velocity_km_s=state[3:])
    speed = None if velocity is None else observer_numbers("--velocity", velocity, 3)
    return Observer.at(time, velocity_km_s=speed)


PriorAttitude = Annotated[str | None, option("prior_q", "--prior-q", metavar="X,Y,Z,W")]
PriorErrorDeg = Annotated[float | None, option("prior_error_deg")]
Track = Annotated[
    bool, typer.Option("--track", help="The frames are a sequence: search each near the last.")
]


def chosen_prior(
    text: str | None, error_deg: float | None, *, track: bool
) -> tuple[list[float], float] | None:
    """Return the attitude that ``--prior-q`` and ``--prior-error-deg`` describe."""
    if text is None and error_deg is None:
        return None
    if text is None or error_deg is None:
        raise ConfigError("--prior-q and --prior-error-deg go together; give both, or neither")
    if track:
        raise ConfigError("--track finds the priors itself", hint="leave out --prior-q, or --track")
    try:
        x, y, z, w = (float(part) for part in text.split(","))
    except ValueError as error:
        raise ConfigError(
            f"--prior-q {text!r} is not X,Y,Z,W, four numbers such as 0.1,-0.2,0.3,0.9"
        ) from error
    return [x, y, z, w], error_deg


def identify_options(given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of `IdentifyOptions` on a command line, by name; without the camera."""
    from starcat.images.identify_options import IdentifyOptions

    prior = chosen_prior(given["prior_q"], given["prior_error_deg"], track=given["track"])
    size_px, fov_deg = unknown_field(given["size"], given["fov"], given["fov_error"])
    options = {name: given.get(name) for name in IdentifyOptions.model_fields if name != "camera"}
    return {
        **options,
        "prior_q": prior[0] if prior else None,
        "fov_error": share_of_percent(given["fov_error"]),
        "size_px": size_px,
        "fov_deg": fov_deg,
    }
