"""What the commands about specs print."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from starcat.cli.terminal.console import out, print_json, print_table, say

if TYPE_CHECKING:
    from starcat.pipeline.starter import Starter
    from starcat.specs.build_spec import BuildSpec


def print_presets(*, as_json: bool) -> None:
    """Print the presets."""
    from starcat.specs.reading import preset, preset_names

    specs = [preset(name) for name in preset_names()]
    if as_json:
        print_json([spec.model_dump(mode="json") for spec in specs])
        return
    rows = [(spec.name, spec.version, spec.catalog.source, spec.description) for spec in specs]
    print_table("", ("preset", "version", "source", "what it is"), rows)


def print_preset(spec: BuildSpec, *, as_json: bool) -> None:
    """Print one preset in a few lines."""
    if as_json:
        print_json(spec.model_dump(mode="json"))
        return
    camera, limits = spec.camera.camera(), spec.selection
    rows = [
        ("what it is", spec.description),
        ("sources", ", ".join(spec.sources)),
        ("limits", f"{limits.bright_limit_mag:g} to {limits.faint_limit_mag:g} mag"),
        ("camera", f"{camera.width_px} x {camera.height_px} px"),
        ("field", f"{camera.fov_x_deg:.4g} x {camera.fov_y_deg:.4g} deg"),
        ("boresights", f"{spec.boresights.count:,}"),
        ("epoch", f"J{spec.epoch_jyear:g}"),
        ("every key", f"starcat presets {spec.name} --toml"),
    ]
    print_table(f"{spec.name} {spec.version}", ("", ""), rows)


def print_starter(starter: Starter, path: Path, *, as_json: bool) -> None:
    """Print what a first spec gives, and what to think of before it is kept."""
    from starcat.pipeline.starter import ENOUGH_STARS, STARS_A_FIELD, advice

    told = advice(starter)
    if as_json:
        print_json(
            {
                "file": str(path),
                "spec": starter.spec.model_dump(mode="json"),
                "limits": [asdict(row) for row in starter.limits],
                "thinned": asdict(starter.thinned),
                "estimate": asdict(starter.cost),
                "advice": list(told),
            }
        )
        return
    camera = starter.spec.camera.camera()
    rows = [
        (
            f"{row.faint_limit_mag:g}" + (" *" if row is starter.own else ""),
            f"{row.guide_stars:,}",
            f"{row.stars.minimum:,}",
            f"{row.stars.one_percent:,}",
            f"{row.stars.median:,}",
            f"{row.stars.maximum:,}",
        )
        for row in starter.limits
    ]
    heads = ("faint limit, G", "guide stars", "fewest", "1 %", "median", "most")
    field = f"{camera.fov_x_deg:.4g} x {camera.fov_y_deg:.4g} deg"
    title = f"Stars in a field of {field} (* the spec's limit)"
    print_table(title, heads, rows, numbers=(0, 1, 2, 3, 4, 5))
    thinned = starter.thinned
    out().print(
        f"\nThe {STARS_A_FIELD} brightest of every field are kept: {thinned.guide_stars:,} guide "
        f"stars, {thinned.stars.minimum:,} to\n{thinned.stars.maximum:,} a field, "
        f"{thinned.stars.median:,} in the middle one."
        "\nA frame needs 4 stars. A limit is good when 1 % of the fields have about "
        f"{ENOUGH_STARS}:\nsome are left where spots are missing, and the database stays small."
    )
    for text in told:
        say(f"warning: {text}")
    say(starter.cost.in_words)
    say(f"wrote {path}; change it as you like, then: starcat build {path}")
