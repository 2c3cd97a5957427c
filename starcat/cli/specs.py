"""Commands about build specs: presets, estimate, init, and their tables."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from starcat.cli.console import (
    command_line,
    print_json,
    print_record,
    progress_bars,
    say,
    show_result,
    warn,
)
from starcat.cli.options import (
    Changes,
    Input,
    Json,
    OwnSources,
    PresetName,
    SpecFile,
    camera_of_options,
    chosen_spec,
    inputs_by_source,
)
from starcat.cli.outputs import Replace
from starcat.errors import ConfigError
from starcat.matcher.option_texts import field_range, size_in_px
from starcat.results import plain, to_dict

if TYPE_CHECKING:
    from starcat.pipeline.specs.build_spec import CameraSpec
    from starcat.pipeline.starter import Starter, StarterCatalog
    from starcat.progress import Progress

app = typer.Typer()

ESTIMATED = {
    "": (
        "guide_stars", "fields.count", "fields.stars.minimum", "fields.stars.one_percent",
        "fields.stars.median", "fields.stars.maximum", "fields.enough_share", "fields.full_share",
        "total_bytes", "memory_bytes",
    ),
    "rejected": ("reason", "records"),
    "rows": ("product", "rows"),
    "files": ("file", "bytes"),
}  # fmt: skip
"""What 'starcat estimate' shows."""

STARTED = {
    "": (
        "thinned.faint_limit_mag", "thinned.guide_stars", "thinned.stars.minimum",
        "thinned.stars.median", "thinned.stars.maximum",
    )
}  # fmt: skip
"""What 'starcat init' shows."""


@app.command("presets")
def presets_command(
    name: Annotated[str | None, typer.Argument(help="Only this one.")] = None,
    toml: Annotated[
        bool, typer.Option("--toml", help="Print the whole spec with every key explained.")
    ] = False,
    json: Json = False,
) -> None:
    """List the build specs that ship with starcat, or print one as a starting point.

    Example: starcat presets gaia-12deg --toml
    """
    from starcat.pipeline.specs.keys import spec_toml
    from starcat.pipeline.specs.reading import preset, preset_names

    if toml:
        if name is None:
            raise ConfigError(
                "--toml prints one preset", hint="name it, as 'presets sao-12deg --toml'"
            )
        typer.echo(spec_toml(preset(name)), nl=False)
    elif name is not None:
        shown = (
            *("description", "catalog.source", "selection.bright_limit_mag"),
            *("selection.faint_limit_mag", "camera.width_px", "camera.height_px"),
            *("camera.fov_x_deg", "boresights.count", "epoch_jyear"),
        )
        spec = preset(name)
        if json:
            print_json(plain(spec))
        else:
            print_record(plain(spec), f"{name} {spec.version}", shown)
            say(f"every key: starcat presets {name} --toml")
    else:
        columns = ("name", "version", "catalog.source", "description")
        specs = [preset(name) for name in preset_names()]
        show_result(specs, as_json=json, columns={"": columns})


@app.command("estimate")
def estimate_command(
    spec: SpecFile = None,
    preset: PresetName = None,
    changes: Changes = None,
    inputs: Input = None,
    sources: OwnSources = None,
    json: Json = False,
) -> None:
    """Estimate the result of a spec without a build: guide stars, fields, files, memory.

    Example: starcat estimate --preset gaia-12deg --set selection.faint_limit_mag=5.5
    """
    from starcat.pipeline.estimate import estimate_spec

    paths_by_source = inputs_by_source(inputs, maps=sources)
    build_spec = chosen_spec(spec, preset, changes)
    with progress_bars() as progress:
        estimate = estimate_spec(build_spec, paths_by_source, progress=progress)
    figures = estimate.figures
    title = f"{estimate.spec.name}-{estimate.spec.version}, by estimate"
    show_result(figures, title, as_json=json, columns=ESTIMATED)
    if not json:
        say("the stars are as the build will have them; files and memory are estimates")
        warn(figures.warnings)
        for words in figures.refusals:
            say(f"the build will be refused: {words}")


@app.command("init")
def init_command(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="TOML file to write.")],
    more: Annotated[
        list[str] | None, typer.Argument(metavar="[PHOTO...]", help="Further pictures for --from.")
    ] = None,
    size: Annotated[
        str | None, typer.Option(metavar="WIDTHxHEIGHT", help="Size of the detector, pixels.")
    ] = None,
    photos: Annotated[
        list[str] | None,
        typer.Option(
            "--from",
            metavar="PHOTO...",
            help="Pictures or centroids from which the camera is found: files, folders, patterns.",
        ),
    ] = None,
    focal_mm: Annotated[float | None, typer.Option(help="Focal length of the lens.")] = None,
    pixel_um: Annotated[
        str | None, typer.Option(metavar="FLOAT", help="Side of a square pixel.")
    ] = None,
    fov_x_deg: Annotated[
        float | None, typer.Option(help="Field across the width, instead of lens and pixel.")
    ] = None,
    fov_y_deg: Annotated[
        float | None, typer.Option(hidden=True, help="Refused, with advice: pixels are square.")
    ] = None,
    fov_range: Annotated[
        str | None,
        typer.Option(metavar="LOW:HIGH", help="Range of fields across the width, instead of one."),
    ] = None,
    faint_limit: Annotated[
        float | None,
        typer.Option(
            min=-30, max=40, help="Faintest magnitude that the camera sees; default: enough."
        ),
    ] = None,
    response: Annotated[
        str | None,
        typer.Option(help="Response of the sensor: one that 'starcat bands' lists, or a CSV file."),
    ] = None,
    per: Annotated[
        str | None, typer.Option(help="What a CSV file is relative to: photon or energy.")
    ] = None,
    sensor: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Star sensor (TOML), as for 'evaluate --ecss'; it sets the limit."
        ),
    ] = None,
    catalog: Annotated[
        str | None,
        typer.Option(
            metavar="SOURCE",
            help="Catalog of the stars, for fields or limits that the embedded sky does not serve.",
        ),
    ] = None,
    inputs: Input = None,
    sources: OwnSources = None,
    replace: Replace = False,
    json: Json = False,
) -> None:
    """Write a build spec for a camera with comments for every key, and print the stars per field.

    Example: starcat init mycam.toml --size 1280x960 --focal-mm 25 --pixel-um 5.5 --faint-limit 5.8
    """
    from starcat.pipeline.starter import expect_new, starter_spec, write_starter

    expect_new(file, replace=replace)
    fields, stars = (
        None if fov_range is None else field_range(fov_range, "fov_range", "fov_x_deg"),
        catalog_of_options(catalog, inputs, sources),
    )
    if photos:
        if fov_x_deg is not None or focal_mm is not None or pixel_um is not None:
            raise ConfigError(
                "--from finds the field of view",
                hint="leave out --fov-x-deg, --focal-mm and --pixel-um",
            )
        with progress_bars() as progress:
            starter, remarks = starter_of_photos(
                [*photos, *(more or ())], file.stem, size, fields, faint_limit, progress, stars
            )
        write_starter(starter, file, replace=replace, remarks=remarks)
        _show_starter(starter, file, as_json=json, remarks=remarks, sources=sources)
        return
    if more:
        raise ConfigError(
            f"{more[0]!r} is not an option", hint="pictures of the camera go with --from"
        )
    if size is None:
        raise ConfigError(
            "the camera has no size",
            hint="give the size of the detector, --size 1280x960, or pictures, --from",
        )
    if fields is not None:
        if fov_x_deg is not None:
            raise ConfigError(
                "--fov-range and --fov-x-deg are both given", hint="leave out one of them"
            )
        fov_x_deg = fields[0]
    camera = camera_of_options(size, focal_mm, pixel_um, fov_x_deg, fov_y_deg)
    with progress_bars() as progress:
        camera = with_sensor(camera, response, sensor, per)
        starter = starter_spec(
            file.stem, camera, faint_limit, progress, fields and fields[1], catalog=stars
        )
        write_starter(starter, file, replace=replace)
    _show_starter(starter, file, as_json=json, sources=sources)


def catalog_of_options(
    name: str | None, inputs: list[str] | None, sources: list[Path] | None
) -> StarterCatalog:
    """Return the catalog that the options of a command line name; by default the embedded sky."""
    from starcat.catalog.source import source_given
    from starcat.pipeline.starter import EMBEDDED, StarterCatalog

    paths_by_source = inputs_by_source(inputs, maps=sources)
    if name is None:
        if paths_by_source or sources:
            raise ConfigError(
                "--input and --source go with --catalog SOURCE", hint="name the catalog"
            )
        return EMBEDDED
    catalog = source_given(name)
    others = sorted(set(paths_by_source) - {catalog.name})
    if catalog.kind != "stars" or others:
        other = f"--input {others[0]}" if others else f"--catalog {name}"
        raise ConfigError(
            "a first spec has one catalog of stars",
            where=other,
            hint="'starcat sources' lists them",
        )
    return StarterCatalog(catalog.name, paths_by_source)


def starter_of_photos(
    photos: Sequence[str],
    name: str,
    size: str | None,
    fields: tuple[float, float] | None,
    faint_limit: float | None,
    progress: Progress,
    catalog: StarterCatalog,
) -> tuple[Starter, list[str]]:
    """Return the spec of the camera that took pictures, and the origin of its values."""
    from starcat.frames.calibration.first_camera import first_camera, spec_of_photos
    from starcat.frames.images.batch import files_of
    from starcat.matcher.matcher import Matcher
    from starcat.pipeline.blind import FIELDS_DEG, blind_database
    from starcat.pipeline.starter import starter_spec

    paths = files_of(photos)
    matcher = Matcher.open(blind_database(progress, fields_deg=fields, catalog=catalog))
    size_px = None if size is None else size_in_px(size)
    camera = first_camera(matcher, paths, fields or FIELDS_DEG, size_px, progress)
    starter = starter_spec(
        name, camera.spec_camera, faint_limit, progress, reach_mag=camera.reach_mag, catalog=catalog
    )
    spec, remark = spec_of_photos(
        starter.spec, camera.noise_px, camera.reach_mag, is_stated=faint_limit is not None
    )
    return dataclasses.replace(starter, spec=spec), [*camera.remarks(starter.band), remark]


def with_sensor(
    camera: CameraSpec, response: str | None, sensor: Path | None, per: str | None = None
) -> CameraSpec:
    """Return a camera with the band of its sensor, and the light and noise of a frame."""
    if response is None and sensor is None:
        return camera
    from starcat.catalog.bands.response import shipped
    from starcat.pipeline.specs.camera_sensor import (
        NEEDED,
        CameraExposure,
        CameraResponse,
        response_of_file,
    )
    from starcat.pipeline.specs.star_sensor import read_sensor

    content = camera.model_dump()
    if response is not None and Path(response).is_file():
        content["response"] = response_of_file(Path(response), {"per": per})
    elif response is not None:
        shipped(response)
        content["response"] = CameraResponse(name=response).model_dump()
    if sensor is not None:
        sensor_content = read_sensor(sensor).model_dump()
        if sensor_content["aperture_mm"] is None:
            raise ConfigError(
                "zero_point_e_s does not determine the band",
                where=sensor,
                key="aperture_mm",
                hint="give aperture_mm and quantum_efficiency instead",
            )
        names = (*NEEDED, "dark_e_s", "sky_e_s")
        content["exposure"] = CameraExposure(
            **{name: sensor_content[name] for name in names}
        ).model_dump()
    return type(camera).model_validate(content)


def _show_starter(
    starter: Starter,
    path: Path,
    *,
    as_json: bool,
    remarks: Sequence[str] = (),
    sources: Sequence[Path] | None = None,
) -> None:
    """Print the stars that a first spec gives, and advice on the limit."""
    from starcat.pipeline.guide_stars import STARS_A_FIELD
    from starcat.pipeline.starter import ENOUGH_STARS

    figures = starter.figures
    record = {"file": str(path), **to_dict(figures)}
    if remarks:
        record["remarks"] = list(remarks)
    title = f"{starter.spec.description}, limits in {starter.band}"
    show_result(record, title, as_json=as_json, columns=STARTED)
    if as_json:
        return
    for line in remarks:
        say(line)
    say(
        f"thinned: the {STARS_A_FIELD} brightest stars of every field are kept. A frame needs 4 "
        f"stars: choose the limit where 99 of 100 fields have {ENOUGH_STARS} or more, then enough "
        "remain when a few are missed"
    )
    warn(figures.advice)
    if starter.catalog.is_embedded and starter.row_of_spec.faint_limit_mag >= starter.deepest_mag:
        say("a deeper catalog: --catalog SOURCE with its --input, as for 'starcat build'")
    say(figures.in_words)
    options: list[object] = []
    for map_file in sources or ():
        options += ["--source", map_file]
    for source, paths in starter.catalog.inputs.items():
        for where in paths:
            options += ["--input", f"{source}={where}"]
    build = command_line("starcat", "build", path, *options)
    say(f"wrote {path}; change it as you like, then: {build}")
