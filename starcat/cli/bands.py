"""The command about responses: it lists them, or each catalog's relation to the band of one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from starcat.cli.console import show_result
from starcat.cli.options import Json

if TYPE_CHECKING:
    from starcat.catalog.bands.response import Response

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
        shown = ("name", "title", "mean_nm", "counts", "zero_point")
        show_result(_responses(), as_json=json, columns={"": shown})
        return
    target = _response(response, per)
    title = f"{target.name}: {target.title}, mean {target.mean_nm:.0f} nm"
    show_result(_relations(target), title, as_json=json)


def _response(text: str, per: str | None) -> Response:
    from starcat.catalog.bands.response import read_response, shipped

    if text.endswith(".csv") or Path(text).is_file():
        return read_response(Path(text), per)
    return shipped(text)


def _responses() -> list[dict[str, Any]]:
    from starcat.catalog.bands.response import shipped, shipped_names

    names = ("name", "title", "counts", "zero_point", "source")
    return [
        {**{fact: getattr(shipped(name), fact) for fact in names}, "mean_nm": shipped(name).mean_nm}
        for name in shipped_names()
    ]


def _relations(target: Response) -> list[dict[str, Any]]:
    from starcat.catalog.bands.catalogs import BANDS_AND_COLOURS, best_relation

    relations = []
    for source in BANDS_AND_COLOURS:
        relation = best_relation(source, target)
        relations.append(
            {
                "source": source,
                "band": relation.base,
                "colour": "-".join(relation.colour),
                "from_mag": float(relation.colour_mag[0]),
                "to_mag": float(relation.colour_mag[-1]),
                "error_mag": relation.typical_error_mag,
                "without_colour_mag": relation.typical_scatter_mag,
            }
        )
    return relations
