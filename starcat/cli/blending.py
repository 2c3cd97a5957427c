"""The command about close stars: how the sensor of a spec sees them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from starcat.cli import options as opt
from starcat.cli.console import progress_bars, show_result
from starcat.errors import ConfigError

if TYPE_CHECKING:
    pass

app = typer.Typer()


# A declination below 0 is not an option.
@app.command("blend", context_settings={"ignore_unknown_options": True})
def blend_command(
    words: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[SPEC] [RA DEC]",
            help="A build spec (TOML), and RA and Dec of a star of its catalog, degrees.",
        ),
    ] = None,
    preset: opt.PresetName = None,
    changes: opt.Changes = None,
    separation: Annotated[
        float | None, typer.Option(metavar="ARCSEC", help="Separation of two stars; with --mags.")
    ] = None,
    mags: Annotated[
        str | None, typer.Option(metavar="A,B", help="Magnitudes of two stars in the spec's band.")
    ] = None,
    inputs: opt.Input = None,
    workers: opt.Workers = 2,
    json: opt.Json = False,
) -> None:
    """Show how the sensor of a spec sees two close stars, or a star of its catalog.

    Example: starcat blend --preset gaia-12deg --set selection.neighbours.psf_sigma_px=1.0
    --separation 20 --mags 4.0,5.5
    """
    from starcat.frames.sky.observer import observer_numbers
    from starcat.pipeline.blending import sensor_view_at, sensor_view_of_pair

    spec, position = _spec_and_position(words or [])
    build_spec = opt.chosen_spec(spec, preset, changes)
    if position is None and separation is not None and mags is not None:
        view = sensor_view_of_pair(build_spec, separation, observer_numbers("mags", mags, 2))
    elif position is not None and separation is None and mags is None:
        with progress_bars() as progress:
            paths_by_source = opt.inputs_by_source(inputs)
            view = sensor_view_at(
                build_spec, paths_by_source, *position, workers=workers, progress=progress
            )
    else:
        raise ConfigError(
            "expected two stars, or one of the catalog",
            hint="state either two stars, by --separation ARCSEC and --mags A,B, or the RA and Dec "
            "of a star of the catalog, in degrees after the spec",
        )
    shown = (
        *("star", "mag", "separation_arcsec", "is_resolved", "blend_mag", "contamination"),
        *("centroid_offset_px", "is_beyond_limits"),
    )
    show_result(view, as_json=json, columns={"stars": shown})


def _spec_and_position(words: list[str]) -> tuple[Path | None, tuple[float, float] | None]:
    from starcat.matcher.centroid_text import is_number

    for word in words:
        if word.startswith("-") and not is_number(word):
            raise typer.BadParameter(f"no such option: {word}")
    numbers = [float(word) for word in words if is_number(word)]
    others = [word for word in words if not is_number(word)]
    if len(numbers) not in (0, 2) or len(others) > 1:
        raise ConfigError(f"{' '.join(words)!r} is not a spec, or a spec with RA and Dec, degrees")
    position = (numbers[0], numbers[1]) if numbers else None
    return Path(others[0]) if others else None, position
