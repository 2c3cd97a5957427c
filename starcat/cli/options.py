"""Options that several commands share, and how their texts become inputs."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from starcat.errors import ConfigError, Unstated, literal
from starcat.matcher.option_texts import size_in_px
from starcat.matcher.options import OPTIONS, IdentifyOptions, Option, options_of

if TYPE_CHECKING:
    from starcat.frames.sky.observer import Observer
    from starcat.pipeline.specs.build_spec import BuildSpec, CameraSpec


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
    from starcat.frames.images.batch import CENTROID_SUFFIXES
    from starcat.frames.images.contents import IMAGE_SUFFIXES
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
            refuse_part_of_database(path)
            raise ConfigError(
                f"{path} is {kind}",
                hint="the database comes first: the folder <name>-<version> that 'starcat build' "
                "made",
            )


def refuse_part_of_database(path: Path) -> None:
    """Raise ConfigError for a file of a database that is named in place of its folder."""
    from starcat.database.manifest import MANIFEST_NAME

    is_part = path.suffix.lower() in (".h5", ".json", ".parquet")
    if is_part and (path.parent / MANIFEST_NAME).is_file():
        raise ConfigError(
            f"{path} is one file of a database", hint=f"give its folder {literal(path.parent)}"
        )


SPELLINGS = {
    "count": "best",
    "focal_length_mm": "focal-mm",
    "form": "to",
    "height_px": "size HEIGHT",
    "inputs": "input",
    "keep_out_deg": "keep-out",
    "memory_bytes": "memory",
    "prior": "prior-q",
    "products": "product",
    "values": "set",
    "velocity_km_s": "velocity",
    "width_px": "size WIDTH",
}
"""Options without a declaration that are spelled differently from the parameter."""


def option_of(parameter: str, value: str = "", item: str = "", command: str = "") -> str:
    """Return the option of the command line for a parameter of a function.

    Examples
    --------
    >>> option_of("time_limit_s"), option_of("replace", "True"), option_of("threshold", "8")
    ('--time-limit-s', '--replace', '--threshold 8')
    >>> option_of("inputs", item="sao"), option_of("inputs", item="sao", command="starcat sql")
    ('--input sao=PATH', "'starcat sql sao=PATH'")
    """
    if parameter == "per" and command not in ("starcat bands", "starcat init"):
        return f"per = {value}"  # a key of the spec, for which these two commands have an option
    declared = OPTIONS[parameter].spellings[:1] if parameter in OPTIONS else ()
    spelling = SPELLINGS.get(parameter, parameter.replace("_", "-"))
    option = f"--{''.join(declared) or spelling}"
    if item and parameter == "inputs":
        # An input of a query is a target; it stands before the query, without an option.
        return f"'starcat sql {item}=PATH'" if command == "starcat sql" else f"{option} {item}=PATH"
    if item:
        return f"{option} {item}=VALUE"
    value = value.strip('"')
    return option if value in ("", "True") else f"{option} {value}"


def typer_option(declared: Option, description: str | None = None) -> Any:
    """Return the option of a command line for a declared option, with its range and description."""
    is_text = declared.parse is not None
    flags = tuple(f"--{word}" for word in declared.spellings)
    if not flags and declared.kind is bool:
        name = declared.name.replace("_", "-")
        flags = (f"--{name}/--no-{name}" if declared.default is None else f"--{name}",)
    return typer.Option(
        *flags,
        metavar=declared.metavar,
        min=None if is_text or declared.low == -math.inf else declared.low,
        max=None if is_text or declared.high == math.inf else declared.high,
        help=description or declared.described(option_of),
        rich_help_panel=declared.panel,
    )


def command_parameter(declared: Option) -> inspect.Parameter:
    """Return the parameter of a command for a declared option."""
    kind: Any = str if declared.parse is not None else declared.kind
    if declared.default is None:
        kind = kind | None
    return inspect.Parameter(
        declared.name,
        inspect.Parameter.KEYWORD_ONLY,
        default=declared.default,
        annotation=Annotated[kind, typer_option(declared)],
    )


def takes(command: Callable[..., Any], declaration: type, *names: str) -> None:
    """Give a command the options that a dataclass declares, or some of them, as ``**options``.

    Typer reads the signature of a function. There the declared options stand between the arguments
    and the other options. A parameter of the command replaces the declared option of its name.
    """
    signature = inspect.signature(command, eval_str=True)
    signature_parameters = {
        name: each.replace(kind=inspect.Parameter.KEYWORD_ONLY)
        for name, each in signature.parameters.items()
        if each.kind is not inspect.Parameter.VAR_KEYWORD
    }
    arguments = [
        each for each in signature_parameters.values() if each.default is inspect.Parameter.empty
    ]
    options = options_of(declaration)
    declared = {
        name: signature_parameters.get(name) or command_parameter(options[name])
        for name in names or options
    }
    others = [
        each
        for each in signature_parameters.values()
        if each not in arguments and each.name not in declared
    ]
    parameters = [*arguments, *declared.values(), *others]
    command.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {each.name: each.annotation for each in parameters}


def option_values(declaration: type, line_values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of declared options from the values of a command line, by name."""
    values = {}
    for name, each in options_of(declaration).items():
        value = line_values.get(name, each.default)
        values[name] = each.parse(value) if each.parse and isinstance(value, str) else value
    return values


def options_of_line(line_values: Mapping[str, Any]) -> IdentifyOptions:
    """Return the options of an identification on a command line, without the camera."""
    if line_values["track"] and line_values["prior_q"] is not None:
        raise ConfigError("--track finds the priors itself", hint="leave out --prior-q, or --track")
    return IdentifyOptions(**{**option_values(IdentifyOptions, line_values), "camera": None})


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
MethodName = Annotated[str | None, typer_option(OPTIONS["method"])]
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
Time = Annotated[str | None, typer_option(OPTIONS["time"])]
Velocity = Annotated[
    str | None,
    typer.Option(
        metavar="VX,VY,VZ", rich_help_panel="Time and place",
        help="Relative to the Earth, km/s, GCRS; with --time.",
    ),
]  # fmt: skip
Orbit = Annotated[
    str | None,
    typer.Option(
        metavar="X,Y,Z,VX,VY,VZ", rich_help_panel="Time and place",
        help="Position too (km); instead of --velocity.",
    ),
]  # fmt: skip
Flip = Annotated[bool | None, typer_option(OPTIONS["flip"])]
Dark = Annotated[
    Path | None,
    typer.Option(rich_help_panel="Pictures", help="Image with the lid on; it is subtracted."),
]
Mask = Annotated[
    Path | None,
    typer.Option(
        rich_help_panel="Pictures",
        help="Mask image: pixels that are not zero (dead, hot) are ignored.",
    ),
]
Track = Annotated[
    bool,
    typer.Option(
        "--track",
        rich_help_panel="Search",
        help="The frames are a sequence: search each near the last.",
    ),
]

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
    from starcat.pipeline.specs.reading import local_preset, preset_names, read_spec

    if path is not None and name is not None:
        raise ConfigError("a spec file and --preset are both given", hint="leave out one of them")
    if path is not None:
        return read_spec(path, changed_keys(changes))
    if name is None:
        raise ConfigError(
            "no spec", hint=f"name one (TOML), or --preset with one of {', '.join(preset_names())}"
        )
    return local_preset(name, changed_keys(changes))


def changed_keys(texts: list[str] | None) -> dict[str, str]:
    """Return the values of ``KEY=VALUE`` texts by key."""
    changes = {}
    for text in texts or []:
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

    from starcat.pipeline.specs.build_spec import CameraSpec
    from starcat.storage.toml_files import wrong_keys

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
        config_error = next(wrong_keys(error, CameraSpec, "camera"))
        if config_error.parameter is None:
            config_error.parameter, config_error.value = config_error.key, Unstated.UNSTATED
        raise config_error from error


def inputs_by_source(
    texts: list[str] | None, only: str | None = None, maps: list[Path] | None = None
) -> Mapping[str, list[Path]]:
    """Return the paths of ``SOURCE=PATH`` texts by source, after adding the sources of maps."""
    from starcat.catalog.source import give_map, source_given
    from starcat.catalog.store.wire import input_path
    from starcat.storage.download import is_address

    for map_path in maps or []:
        give_map(map_path)
    inputs: dict[str, list[Path]] = {}
    for text in texts or []:
        name, separator, path = text.partition("=")
        if only is not None and (name != only or not separator):
            name, separator, path = only, "=", text
        if not separator or not path:
            raise ConfigError(f"--input {text!r} is not SOURCE=PATH, such as sao=sao.dat.gz")
        source = source_given(name)
        if source.kind != "stars" and is_address(path, "input"):
            raise ConfigError(
                f"--input {text!r}: {source.name} is read from a file",
                hint=f"bring it here with 'starcat fetch {source.name}'. At an address HATS "
                "catalogs of stars are read",
            )
        inputs.setdefault(source.name, []).append(input_path(path))
    return inputs


def observer_of_options(
    time: str | None, velocity: str | None, orbit: str | None
) -> Observer | None:
    """Return the observer that the options of a command line describe."""
    if time is None:
        if velocity is not None or orbit is not None:
            word = "--velocity" if velocity is not None else "--orbit"
            raise ConfigError(f"{word} has no time", hint="state its time with --time")
        return None
    from starcat.frames.sky.observer import Observer, observer_numbers

    if orbit is not None:
        if velocity is not None:
            raise ConfigError(
                "--velocity and --orbit are both given",
                hint="leave out --velocity, which --orbit holds too",
            )
        state = observer_numbers("orbit", orbit, 6)
        try:
            return Observer.at(time, position_km=state[:3], velocity_km_s=state[3:])
        except ConfigError as error:
            if error.parameter in ("position_km", "velocity_km_s"):
                error.parameter, error.value = "orbit", orbit
            raise
    speed = None if velocity is None else observer_numbers("velocity", velocity, 3)
    return Observer.at(time, velocity_km_s=speed)
