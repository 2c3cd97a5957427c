"""The commands about build specs: those that ship with starcat, and a first one for a camera."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from starcat.cli.commands.shared import (
    Changes,
    Input,
    Json,
    PresetName,
    SpecFile,
    camera_of_options,
    chosen_spec,
    field_range,
    inputs_by_source,
)
from starcat.errors import ConfigError

app = typer.Typer()


@app.command()
def presets(
    name: Annotated[str | None, typer.Argument(help="Only this one.")] = None,
    toml: Annotated[
        bool, typer.Option("--toml", help="Print the whole spec with every key explained.")
    ] = False,
    json: Json = False,
) -> None:
    """List the build specs that ship with starcat, or print one to start from.

    Example: starcat presets gaia-12deg --toml
    """
    from starcat.cli.terminal.specs import print_preset, print_presets
    from starcat.specs.keys import spec_toml
    from starcat.specs.reading import preset

    if toml:
        if name is None:
            raise ConfigError("--toml prints one preset: name it, as 'presets sao-12deg --toml'")
        typer.echo(spec_toml(preset(name)), nl=False)
    elif name is not None:
        print_preset(preset(name), as_json=json)
    else:
        print_presets(as_json=json)


@app.command()
def estimate(
    spec: SpecFile = None,
    preset: PresetName = None,
    changes: Changes = None,
    inputs: Input = None,
    json: Json = False,
) -> None:
    """Say what a spec will give without building it: guide stars, fields, files, time, memory.

    Example: starcat estimate --preset gaia-12deg --set selection.faint_limit_mag=5.5
    """
    from starcat.cli.terminal.console import progress_bars
    from starcat.cli.terminal.estimates import print_estimate
    from starcat.pipeline.estimate import estimate_spec

    given, chosen = inputs_by_source(inputs), chosen_spec(spec, preset, changes)
    with progress_bars() as progress:
        found = estimate_spec(chosen, given, progress=progress)
    print_estimate(found, as_json=json)


@app.command()
def init(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="TOML file to write.")],
    size: Annotated[
        str, typer.Option(metavar="WIDTHxHEIGHT", help="Size of the detector, pixels.")
    ],
    focal_mm: Annotated[float | None, typer.Option(help="Focal length of the lens.")] = None,
    pixel_um: Annotated[float | None, typer.Option(help="Side of a square pixel.")] = None,
    fov_x_deg: Annotated[
        float | None, typer.Option(help="Field across the width, instead of lens and pixel.")
    ] = None,
    fov_range: Annotated[
        str | None,
        typer.Option(metavar="LOW:HIGH", help="Fields across the width, instead: a range."),
    ] = None,
    faint_limit: Annotated[
        float | None,
        typer.Option(min=-30, max=40, help="Magnitude G that the camera sees; default: enough."),
    ] = None,
    replace: Annotated[
        bool, typer.Option("--replace", help="Replace a file of that name.")
    ] = False,
    json: Json = False,
) -> None:
    """Write a build spec for a camera, every key explained, and say how many stars a field has.

    Example: starcat init mycam.toml --size 1280x960 --focal-mm 25 --pixel-um 5.5 --faint-limit 5.8
    """
    from starcat.cli.terminal.console import progress_bars
    from starcat.cli.terminal.specs import print_starter
    from starcat.pipeline.starter import starter_spec, write_starter

    fields = field_range(fov_range)
    if fields is not None:
        if fov_x_deg is not None:
            raise ConfigError("give either --fov-range or --fov-x-deg, not both")
        fov_x_deg = fields[0]
    camera = camera_of_options(size, focal_mm, pixel_um, fov_x_deg)
    with progress_bars() as progress:
        starter = starter_spec(file.stem, camera, faint_limit, progress, fields and fields[1])
        write_starter(starter, file, replace=replace)
    print_starter(starter, file, as_json=json)
