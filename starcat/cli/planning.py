"""The command that plans: the stars that a star sensor will see at future attitudes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from starcat.cli import options as opt
from starcat.cli.console import print_json, print_table, print_things, say
from starcat.cli.outputs import expect_room
from starcat.errors import ConfigError
from starcat.frames.planning.options import PlanOptions
from starcat.results import to_dict

if TYPE_CHECKING:
    from starcat.frames.planning.choice import Choice
    from starcat.frames.planning.plan_result import Plan

app = typer.Typer()

MAX_ROWS = 40
"""Most attitudes and gaps in a table; ``--json`` has all."""


def plan_command(
    database: Annotated[Path, typer.Argument(help="The folder <name>-<version>.")],
    attitudes: Annotated[
        str,
        typer.Argument(
            help="CSV with time and qx,qy,qz,qw or ra_deg,dec_deg,roll_deg; CCSDS AEM (KVN); or "
            "one pointing, RA,DEC,ROLL in degrees."
        ),
    ],
    orbit: Annotated[
        Path | None,
        typer.Option(help="CSV with time, x_km to z_km and vx_km_s to vz_km_s; CCSDS OEM (KVN)."),
    ] = None,
    time: opt.Time = None,
    alignment: Annotated[
        str | None,
        typer.Option(metavar="X,Y,Z,W", help="Quaternion from the attitudes' frame to the camera."),
    ] = None,
    camera: Annotated[
        Path | None, typer.Option(help="Camera file (TOML); default: the database's camera.")
    ] = None,
    keep_out: Annotated[
        str | None,
        typer.Option(
            metavar="BODY=DEG,...", help="Smallest angles, such as Sun=30,Moon=15,Earth=20."
        ),
    ] = None,
    best: Annotated[
        int | None,
        typer.Option(min=1, max=1000, metavar="N", help="Choose N guide stars for one attitude."),
    ] = None,
    row: Annotated[
        int | None,
        typer.Option(min=1, help="Attitude of --best and of the table of stars, from 1."),
    ] = None,
    plot: Annotated[Path | None, typer.Option(help="PNG or SVG of the plan over time.")] = None,
    json: opt.Json = False,
    **options: Any,
) -> None:
    """Plan what a star sensor will see: stars, errors, acquisition, Sun, Moon, Earth, and gaps.

    Example: starcat plan dist/gaia-12deg-1.0.0 83.8,-5.4,0 --time 2027-01-01T00:00:00
    --keep-out Sun=30,Moon=15 --best 8 --plot plan.png
    """
    from starcat.frames.planning.drawing import draw_plan
    from starcat.frames.planning.plan import plan
    from starcat.frames.sky.observer import observer_numbers
    from starcat.pipeline.specs.camera_file import read_camera
    from starcat.storage.figures import check_kind

    check_kind(plot)
    expect_room(plot=plot)
    result = plan(
        database,
        _attitudes(attitudes, time),
        orbit=orbit,
        alignment=None if alignment is None else observer_numbers("alignment", alignment, 4),
        camera=None if camera is None else read_camera(camera),
        keep_out_deg=_keep_out(keep_out),
        **options,
    )
    choice = None
    if row is not None and row > len(result):
        raise ConfigError(f"the table has {len(result)} attitudes", parameter="row", value=row)
    if best is not None:
        if row is None and len(result) > 1:
            raise ConfigError(
                "--best is for one attitude", hint=f"choose one of the {len(result)} with --row"
            )
        choice = result.best(best, (row or 1) - 1)
    if plot is not None:
        draw_plan(result, plot)
    if json:
        print_json({**result.to_dict(), **({"best": to_dict(choice)} if choice else {})})
    else:
        print_plan(result, (row or 1) - 1 if row or len(result) == 1 else None, choice)
    if plot is not None:
        say(f"written: {plot}")


opt.takes(plan_command, PlanOptions)
app.command("plan")(plan_command)


def _attitudes(text: str, time: str | None) -> Any:
    """Return ATTITUDES as a path, or as a table with one pointing."""
    from starcat.matcher.centroid_text import is_number

    words = text.split(",")
    if len(words) == 3 and all(map(is_number, words)):
        columns = dict(zip(("ra_deg", "dec_deg", "roll_deg"), words, strict=True))
        table: dict[str, list[str]] = {name: [word] for name, word in columns.items()}
        return table if time is None else {"time": [time], **table}
    if time is not None:
        raise ConfigError(
            "--time is for one pointing, RA,DEC,ROLL", hint="in a table use the column time"
        )
    return Path(text)


def _keep_out(text: str | None) -> dict[str, float]:
    from starcat.matcher.centroid_text import is_number

    angles = {}
    for part in (text or "").split(",") if text else ():
        name, _, angle = part.partition("=")
        if not is_number(angle):
            text = f"--keep-out {part!r} is not BODY=DEG, such as Sun=30,Moon=15,Earth=20"
            raise ConfigError(text)
        angles[name.strip().capitalize()] = float(angle)
    return angles


def print_plan(plan: Plan, row: int | None, choice: Choice | None) -> None:
    """Print attitudes, gaps, the stars of one attitude, and the stars chosen for it."""
    rows = [_cells(plan, k) for k in range(min(len(plan), MAX_ROWS))]
    facts = plan.summary
    more = f", the first {MAX_ROWS} shown" if len(plan) > MAX_ROWS else ""
    title = f"{plan.database.name}: {len(plan):,} attitudes, {facts['usable']:,} usable{more}"
    heads = ("UTC" if plan.attitudes.times else "attitude", "RA", "Dec", "stars", "error, arcsec",
             "acq.", "Sun", "Moon", "Earth", "!keep-out")  # fmt: skip
    print_table(title, heads, rows, numbers=range(1, 9))
    gaps = [
        (gap.start or gap.first + 1, gap.end or gap.last + 1, gap.last - gap.first + 1,
         ", ".join(gap.reasons))
        for gap in plan.gaps[:MAX_ROWS]
    ]  # fmt: skip
    print_table(f"Gaps: {len(plan.gaps)}", ("from", "to", "attitudes", "because of"), gaps, (2,))
    if choice is not None:
        stars: list[dict[str, Any]] = [
            *({**star, "why": f"taken in stage {star['stage']}"} for star in choice.taken),
            *({**star, "why": f"no: {star['reason']}"} for star in choice.left),
        ]
        shown = {"choice": "{0[why]}"}
        _print_stars(f"Guide stars: {len(choice.taken)} taken", stars, shown)
    elif row is not None:
        shown = {"contam.": "{0[contamination]:.3f}", "offset px": "{0[centroid_offset_px]:.3f}"}
        _print_stars(f"Guide stars of attitude {row + 1}", plan.stars_of(row), shown)


def _cells(plan: Plan, row: int) -> list[str]:
    facts = plan.attitude(row)
    angles = facts["angles_deg"]
    notes = [f"!{name}" for name in facts["keep_out_violated"]]
    notes += [body["name"] for body in facts["bodies_in_frame"]]
    return [
        (facts["time"] or str(row + 1))[:19],
        f"{facts['boresight_ra_deg']:.1f}",
        f"{facts['boresight_dec_deg']:+.1f}",
        f"{facts['stars_expected']:.1f}",
        " ".join("-" if error is None else f"{error:.1f}" for error in facts["error_arcsec"]),
        f"{facts['acquisition_probability']:.3f}",
        *(f"{angles[name]:.0f}" if name in angles else "-" for name in ("Sun", "Moon", "Earth")),
        " ".join(notes),
    ]


def _print_stars(title: str, stars: list[dict[str, Any]], more: dict[str, str]) -> None:
    columns = {
        "star": "{0[star]}",
        "mag": "{0[mag]:.2f}",
        "x px": "{0[x_px]:.1f}",
        "y px": "{0[y_px]:.1f}",
        "seen": "{0[detection_probability]:.3f}",
        "alike": "{0[lookalikes]}",
        **more,
    }
    numbers = range(1, 6) if "choice" in more else range(1, 8)
    print_things(title, stars, columns, numbers, nothing="-")
