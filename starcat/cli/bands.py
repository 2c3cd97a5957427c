"""The command about responses: it lists them, or each catalog's relation to the band of one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from starcat.cli.console import print_table, show
from starcat.cli.options import Json

if TYPE_CHECKING:
    from starcat.bands.response import Response

app = typer.Typer()


@app.command("bands")
def bands(
    response: Annotated[
        str | None,
        typer.Argument(help="A response that ships with starcat, or the path of a CSV file."),
    ] = None,
    per: Annotated[
        str | None, typer.Option(help="What a CSV file is relative to: photon or energy.")
    ] = None,
    json: Json = False,
) -> None:
    """List the responses of sensors and passbands, or how each catalog predicts one of them.

    Example: starcat bands silicon-cmos
    """
    if response is None:
        found = _responses()
        show(json, found, _print_responses, found)
        return
    target = _response(response, per)
    facts = _relations(target)
    show(json, facts, _print_relations, target, facts)


def _response(text: str, per: str | None) -> Response:
    from starcat.bands.response import read_response, shipped

    if text.endswith(".csv") or Path(text).is_file():
        return read_response(Path(text), per)
    return shipped(text)


def _responses() -> list[dict[str, Any]]:
    from starcat.bands.response import shipped, shipped_names

    names = ("name", "title", "counts", "zero_point", "source")
    return [
        {**{fact: getattr(shipped(name), fact) for fact in names}, "mean_nm": shipped(name).mean_nm}
        for name in shipped_names()
    ]


def _print_responses(found: list[dict[str, Any]]) -> None:
    rows = [
        (one["name"], one["title"], f"{one['mean_nm']:.0f}", one["counts"], one["zero_point"])
        for one in found
    ]
    print_table("", ("response", "of", "mean nm", "per", "zero point"), rows, numbers=(2,))


def _relations(target: Response) -> list[dict[str, Any]]:
    from starcat.bands.catalogs import BANDS_AND_COLOURS, best_relation

    found = []
    for source in BANDS_AND_COLOURS:
        made = best_relation(source, target)
        found.append(
            {
                "source": source,
                "band": made.base,
                "colour": "-".join(made.colour),
                "from_mag": float(made.colour_mag[0]),
                "to_mag": float(made.colour_mag[-1]),
                "error_mag": made.typical_error_mag,
                "without_colour_mag": made.typical_scatter_mag,
            }
        )
    return found


def _print_relations(target: Response, found: list[dict[str, Any]]) -> None:
    rows = [
        (
            one["source"],
            one["band"],
            f"{one['colour']} {one['from_mag']:.2f} to {one['to_mag']:.2f}",
            f"{one['error_mag']:.3f}",
            f"{one['without_colour_mag']:.2f}",
        )
        for one in found
    ]
    heads = ("catalog", "from", "by the colour", "error, mag", "without a colour")
    title = f"{target.name}: {target.title}, mean {target.mean_nm:.0f} nm"
    print_table(title, heads, rows, numbers=(3, 4))
