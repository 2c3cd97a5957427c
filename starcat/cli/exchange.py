"""The command that writes tables for other tools and images for flight software."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from starcat.cli.console import say, show_result
from starcat.cli.options import Json
from starcat.cli.outputs import Replace, to_either
from starcat.database.onboard.flight_limits import FLIGHT_CENTROIDS, stars_in_flight
from starcat.database.onboard.profiles import PROFILES
from starcat.errors import ConfigError, count_of
from starcat.results import to_dict
from starcat.ship.exchange.formats import (
    EXPORT_FORMATS,
    ONBOARD_FORMATS,
    SOLVER_FORMATS,
    suffix_format,
)

if TYPE_CHECKING:
    from starcat.ship.exchange.onboard import ExportedImage

app = typer.Typer()


SourcePath = Annotated[
    Path | None, typer.Argument(metavar="SOURCE", help="A database's folder, or a Parquet file.")
]
FormatName = Annotated[
    str | None,
    typer.Option(
        "--to",
        "--format",
        metavar="FORMAT",
        help="Default: by the suffix of --output, or csv. "
        f"{', '.join(EXPORT_FORMATS[:-1])} or {EXPORT_FORMATS[-1]}; "
        f"{' or '.join(ONBOARD_FORMATS)} for flight software; for other solvers "
        f"{', '.join(SOLVER_FORMATS[:-1])} or {SOLVER_FORMATS[-1]}.",
    ),
]
OutputPath = Annotated[
    Path | None,
    to_either(
        "Where the result goes: with a suffix the file of one product, else the folder of all, "
        "default: export; for onboard and c the file, default: <name>-<version>.img or .c; for "
        "other solvers the folder, default: <name>-<version>-<format>."
    ),
]
MaxPartitionRows = Annotated[
    int | None, typer.Option(min=1, help="Stars in a file of HATS; default: 1,000,000.")
]
Method = Annotated[
    str | None,
    typer.Option(help="onboard, c: triangle or pyramid; default: triangle, or the profile's."),
]
ProfileName = Annotated[
    str | None,
    typer.Option(
        help=f"onboard, c: {' or '.join(PROFILES)}; small: short pairs of bright stars, for little "
        "memory. The identification rate of the image is measured."
    ),
]
Endian = Annotated[
    str | None, typer.Option(help="onboard, c: byte order, little or big; default: little.")
]
MaxBytes = Annotated[
    int | None, typer.Option(min=1, help="onboard, c: largest image size; default: no limit.")
]
Sign = Annotated[
    list[Path] | None, typer.Option(help="onboard, c: key to sign the image with. Repeatable.")
]
PatchFrom = Annotated[
    Path | None,
    typer.Option(help="onboard: image in flight; a patch from it is written next to the new one."),
]
CameraToC = Annotated[
    Path | None,
    typer.Option(
        "--camera",
        metavar="camera.toml",
        help="onboard, c: calibrated camera; written for C next to the image, as *_camera.h.",
    ),
]


@app.command("export")
def export_command(
    source: SourcePath = None,
    form: FormatName = None,
    output: OutputPath = None,
    product: Annotated[
        list[str] | None, typer.Option(help="Product of a database; default: all. Repeatable.")
    ] = None,
    replace: Replace = False,
    max_partition_rows: MaxPartitionRows = None,
    profile: ProfileName = None,
    method: Method = None,
    endian: Endian = None,
    max_bytes: MaxBytes = None,
    patch_from: PatchFrom = None,
    sign: Sign = None,
    camera: CameraToC = None,
    json: Json = False,
) -> None:
    """Write tables for other tools, an image for flight software, or other solvers' databases.

    Example: starcat export dist/gaia-12deg-1.0.0 --to fits -o fits
    """
    of_images: dict[str, Any] = {
        "profile": profile,
        "method": method,
        "endian": endian,
        "max_bytes": max_bytes,
        "patch_from": patch_from,
        "sign": sign,
        "camera": camera,
    }
    form = form or _form_of(output)
    of_tables: dict[str, object] = {"product": product}
    of_hats: dict[str, object] = {"max_partition_rows": max_partition_rows}
    if form in ONBOARD_FORMATS:
        _refuse(form, of_tables | of_hats)
        _for_flight(_named(source), form, output, {**of_images, "replace": replace}, json)
        return
    if form in SOLVER_FORMATS:
        _refuse(form, of_tables | of_hats | of_images)
        _for_solver(_named(source), form, output, replace, json)
        return
    _refuse(form, of_images if form == "hats" else of_images | of_hats)
    from starcat.ship.exchange.export import MAX_ROWS, export_tables, tables_of

    exported = export_tables(
        tables_of(_named(source)),
        form,
        output or Path("export"),
        products=product,
        replace=replace,
        max_partition_rows=max_partition_rows or MAX_ROWS,
    )
    for file in exported.files:
        if file.left_out:
            say(f"{file.product}: {count_of(file.left_out, 'row')} without a position left out")
    show_result(exported, as_json=json, columns={"files": ("product", "name", "rows", "bytes")})
    if exported.columns and not json:
        typer.echo(f"{exported.columns} describes the columns")


def _form_of(output: Path | None) -> str:
    """Return the format that an output's suffix selects; csv without one."""
    if output is None:
        return "csv"
    image_formats = {".img": "onboard", ".c": "c"}
    return image_formats.get(output.suffix.lower()) or suffix_format(output) or "csv"


def _for_flight(
    database: Path, form: str, output: Path | None, options: Mapping[str, Any], json: bool
) -> None:
    from starcat.ship.exchange.onboard import export_image

    image_options = {name: value for name, value in options.items() if value is not None}
    image = export_image(database, form, output, **image_options)
    _say_left_out(image)
    record = to_dict(image)
    if not json:
        record["a frame in flight"] = f"at most {FLIGHT_CENTROIDS} centroids: give the brightest"
    shown = (
        *("source", "format", "endian", "method", "stars", "stars_in_database", "features"),
        *("features_without_limit", "image_bytes", "crc", "a frame in flight", "patch_bytes"),
        *("profile", "voting_bytes", "signed_by", "files"),
    )
    columns = {"": [key for key in shown if record.get(key)]}
    show_result(record, as_json=json, columns=columns)


def _for_solver(
    database: Path, solver: str, output: Path | None, replace: bool, json: bool
) -> None:
    from starcat.ship.exchange.solvers.write import export_solver

    exported = export_solver(database, solver, output, replace=replace)
    record = to_dict(exported)
    if not json:
        shown = ("database", "solver", "epoch_jyear", "stars", "faintest_mag", "folder")
        record = {key: record[key] for key in shown} | exported.made | {"to load": exported.main}
    show_result(record, as_json=json)


def _refuse(form: str, options: Mapping[str, object]) -> None:
    for name, value in options.items():
        if value is not None:
            option = f"--{name.replace('_', '-')}"
            raise ConfigError(
                f"{option} has no effect with --to {form}", key=name, hint="leave it out"
            )


def _named(source: Path | None) -> Path:
    if source is None:
        raise ConfigError("nothing to export", hint="name a database's folder or a Parquet file")
    return source


def _say_left_out(exported: ExportedImage) -> None:
    fitted, image = exported.fitted, exported.image
    noun = _features(fitted.contents.method)
    why = "to fit" if exported.profile is None else f"by the profile {exported.profile}"
    if fitted.features < fitted.features_before:
        say(f"{fitted.features_before - fitted.features:,} {noun} are left out, {why}")
    if fitted.stars_per_field is not None:
        say(
            f"{fitted.stars_before - fitted.stars:,} stars are left out, {why}: they are "
            f"not among the {fitted.stars_per_field} brightest of a field"
        )
    for sentence in stars_in_flight(image.most_near):
        say(sentence)
    if image.most_near > FLIGHT_CENTROIDS:
        say(
            f"a frame may show {image.most_near} stars: give the onboard library the brightest "
            f"{FLIGHT_CENTROIDS} centroids, or compile it with "
            f"-DSTARCAT_MAX_CENTROIDS={image.most_near}; it refuses a frame with more"
        )


def _features(method: str) -> str:
    return "triangles" if method == "triangle" else "pairs"
