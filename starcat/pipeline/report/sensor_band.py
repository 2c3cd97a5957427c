"""The band of the sensor in a report: response, relation, and limits in catalog bands."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from starcat.catalog.bands.relation import Relation
from starcat.catalog.bands.response import shipped
from starcat.catalog.bands.synthetic import library, synthetic_magnitudes
from starcat.catalog.sensor_band import InBand
from starcat.pipeline.report.page import figure, table
from starcat.pipeline.report.plots import STYLE, headline
from starcat.pipeline.selection.ruleset import Selection
from starcat.storage.figures import own_style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TYPES = ("b3v", "a0v", "f5v", "g2v", "k2iii", "m0iii", "m4iii")
"""Types of stars for which limits are given."""

_COLOURS = ("#d1495b", "#b9c4cc", "#8a97a0", "#5b6770")


def band_content(in_band: InBand, selection: Selection) -> dict[str, Any]:
    """Return the part of report.json on the band."""
    response, base = in_band.response, shipped(in_band.band)
    difference = (synthetic_magnitudes(response) - synthetic_magnitudes(base))[0]
    rows = [library().types.index(name) for name in TYPES]
    limits = {"faint": selection.faint_limit_mag}
    if selection.bright_limit_mag > -30.0:
        limits["bright"] = selection.bright_limit_mag
    content: dict[str, Any] = {
        "response": response.name,
        "title": response.title,
        "mean_nm": round(response.mean_nm, 1),
        "zero_point": response.zero_point,
        "source": response.source,
        "catalog_band": in_band.band,
        "stars_by_source": in_band.counts,
        "outside_colours": in_band.outside,
        "limits_in_catalog_band": [
            {"type": name.upper(), "difference_mag": round(float(difference[row]), 3)}
            | {
                f"{kind}_mag": round(mag - float(difference[row]), 3)
                for kind, mag in limits.items()
            }
            for name, row in zip(TYPES, rows, strict=True)
        ],
    }
    if in_band.relation is not None:
        content["relation"] = _relation_content(in_band.relation)
    return content


def _relation_content(relation: Relation) -> dict[str, Any]:
    every = slice(None, None, 10)
    return {
        "band": relation.base,
        "colour": "-".join(relation.colour),
        "colour_mag": np.round(relation.colour_mag[every], 3).tolist(),
        "offset_mag": np.round(relation.offset_mag[every], 4).tolist(),
        "error_mag": np.round(relation.error_mag[every], 4).tolist(),
    }


def draw_band(title: str, in_band: InBand) -> Figure:
    """Draw the response with the catalog's passbands, and the relation with its residuals."""
    from matplotlib.figure import Figure

    with own_style(STYLE):
        drawing = Figure(figsize=(7.2, 7.4))
        headline(drawing, f"{title}: the band {in_band.response.name}", in_band.response.title)
        _draw_responses(drawing.add_axes((0.12, 0.7, 0.85, 0.2)), in_band)
        if in_band.relation is not None:
            _draw_relation(drawing.add_axes((0.12, 0.35, 0.85, 0.25)), in_band.relation)
            _draw_residuals(drawing.add_axes((0.12, 0.08, 0.85, 0.2)), in_band.relation)
    return drawing


def _draw_responses(axes: Axes, in_band: InBand) -> None:
    relation = in_band.relation
    names = [in_band.band] if relation is None else [relation.base, *relation.colour]
    others = [shipped(name) for name in dict.fromkeys(names)]
    at = np.arange(300.0, 2500.0, 2.0)
    for response, colour in zip([in_band.response, *others], _COLOURS, strict=False):
        is_own = response is in_band.response
        curve = response.photon_efficiency(at)
        axes.plot(at, curve, color=colour, lw=1.8 if is_own else 1.0, label=response.name)
    lit = [response.wavelength_nm[response.value > 0] for response in (in_band.response, *others)]
    axes.set_xlim(min(w[0] for w in lit) - 20.0, min(2500.0, max(w[-1] for w in lit) + 20.0))
    axes.set(xlabel="wavelength, nm", ylabel="electrons a photon")
    axes.legend(loc="upper right", frameon=False)


def _draw_relation(axes: Axes, relation: Relation) -> None:
    x, y, size = _spectra(relation)
    axes.scatter(x, y, s=size, color="#b9c4cc", lw=0, label="spectra")
    error = relation.error_mag
    low, high = relation.offset_mag - error, relation.offset_mag + error
    axes.fill_between(relation.colour_mag, low, high, color="#2c6e9e", alpha=0.25, lw=0)
    axes.plot(relation.colour_mag, relation.offset_mag, color="#2c6e9e", label="relation")
    axes.set(ylabel=f"{relation.target.name} - {relation.base}, mag")
    axes.legend(loc="upper right", frameon=False)


def _draw_residuals(axes: Axes, relation: Relation) -> None:
    x, y, size = _spectra(relation)
    residual = y - np.interp(x, relation.colour_mag, relation.offset_mag)
    axes.scatter(x, residual, s=size, color="#b9c4cc", lw=0)
    for sign in (-1.0, 1.0):
        axes.plot(relation.colour_mag, sign * relation.error_mag, color="#2c6e9e", lw=1.0)
    reach = 3.0 * float(np.quantile(relation.error_mag, 0.9, method="inverted_cdf"))
    axes.set(
        xlabel=f"{'-'.join(relation.colour)}, mag", ylabel="residual, mag", ylim=(-reach, reach)
    )


def _spectra(relation: Relation) -> tuple[Any, Any, Any]:
    """Return colour, offset and size of the point of each spectrum."""
    first, second = (synthetic_magnitudes(shipped(band)) for band in relation.colour)
    offset = synthetic_magnitudes(relation.target) - synthetic_magnitudes(shipped(relation.base))
    size = 2.0 + 400.0 * np.sqrt(library().weight / library().weight.sum()) ** 1.5
    return (first - second).ravel(), offset.ravel(), size.ravel()


_ALT = "Response by wavelength, relation by colour and its residuals"


def band_section(band: Mapping[str, Any], drawn: bytes) -> list[str]:
    """Return the section of the report's page."""
    counts = [(name, number) for name, number in band["stars_by_source"].items()]
    counts.append(("colour outside of the library's", band["outside_colours"]))
    rows = [tuple(row.values()) for row in band["limits_in_catalog_band"]]
    kinds = [key.removesuffix("_mag") for key in list(band["limits_in_catalog_band"][0])[2:]]
    heads = ("type", f"{band['response']} - {band['catalog_band']}", *(f"{k} limit" for k in kinds))
    text = (
        f"<p>Magnitudes and limits are in the band {escape(band['response'])}: "
        f"{escape(band['title'])}, mean wavelength {band['mean_nm']:g} nm, zero point "
        f"{escape(band['zero_point'])}. The catalog's are in {escape(band['catalog_band'])}.</p>"
    )
    caption = f"The limits in {band['catalog_band']}, by type of star, without reddening"
    return [
        "<h2>Band of the sensor</h2>",
        text,
        table("Magnitudes are made from", ("", "stars"), counts, (1,)),
        table(caption, heads, rows, range(1, len(heads))),
        figure(_ALT, drawn),
    ]
