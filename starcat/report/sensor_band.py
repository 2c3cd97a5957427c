"""The band of the sensor in a report: response, relation, and limits in catalog bands."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from starcat.bands.relation import Relation
from starcat.bands.response import shipped
from starcat.bands.synthetic import library, synthetic_magnitudes
from starcat.catalog.sensor_band import InBand
from starcat.report.page import figure, table
from starcat.report.plots import STYLE, headline
from starcat.selection.ruleset import Selection
from starcat.storage.figures import own_style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TYPES = ("b3v", "a0v", "f5v", "g2v", "k2iii", "m0iii", "m4iii")
"""Types of stars for which limits are given."""

_COLOURS = ("#d1495b", "#b9c4cc", "#8a97a0", "#5b6770")


def band_content(made: InBand, selection: Selection) -> dict[str, Any]:
    """Return the part of report.json on the band."""
    response, base = made.response, shipped(made.band)
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
        "catalog_band": made.band,
        "stars_by_source": made.counts,
        "outside_colours": made.outside,
        "limits_in_catalog_band": [
            {"type": name.upper(), "difference_mag": round(float(difference[row]), 3)}
            | {
                f"{kind}_mag": round(mag - float(difference[row]), 3)
                for kind, mag in limits.items()
            }
            for name, row in zip(TYPES, rows, strict=True)
        ],
    }
    if made.relation is not None:
        content["relation"] = _relation_content(made.relation)
    return content


def _relation_content(made: Relation) -> dict[str, Any]:
    every = slice(None, None, 10)
    return {
        "band": made.base,
        "colour": "-".join(made.colour),
        "colour_mag": np.round(made.colour_mag[every], 3).tolist(),
        "offset_mag": np.round(made.offset_mag[every], 4).tolist(),
        "error_mag": np.round(made.error_mag[every], 4).tolist(),
    }


def draw_band(title: str, made: InBand) -> Figure:
    """Draw the response with the catalog's passbands, and the relation with its residuals."""
    from matplotlib.figure import Figure

    with own_style(STYLE):
        drawing = Figure(figsize=(7.2, 7.4))
        headline(drawing, f"{title}: the band {made.response.name}", made.response.title)
        _draw_responses(drawing.add_axes((0.12, 0.7, 0.85, 0.2)), made)
        if made.relation is not None:
            _draw_relation(drawing.add_axes((0.12, 0.35, 0.85, 0.25)), made.relation)
            _draw_residuals(drawing.add_axes((0.12, 0.08, 0.85, 0.2)), made.relation)
    return drawing


def _draw_responses(axes: Axes, made: InBand) -> None:
    relation = made.relation
    names = [made.band] if relation is None else [relation.base, *relation.colour]
    others = [shipped(name) for name in dict.fromkeys(names)]
    at = np.arange(300.0, 2500.0, 2.0)
    for one, colour in zip([made.response, *others], _COLOURS, strict=False):
        is_own = one is made.response
        curve = one.photon_efficiency(at)
        axes.plot(at, curve, color=colour, lw=1.8 if is_own else 1.0, label=one.name)
    lit = [one.wavelength_nm[one.value > 0] for one in (made.response, *others)]
    axes.set_xlim(min(w[0] for w in lit) - 20.0, min(2500.0, max(w[-1] for w in lit) + 20.0))
    axes.set(xlabel="wavelength, nm", ylabel="electrons a photon")
    axes.legend(loc="upper right", frameon=False)


def _draw_relation(axes: Axes, made: Relation) -> None:
    x, y, size = _spectra(made)
    axes.scatter(x, y, s=size, color="#b9c4cc", lw=0, label="spectra")
    error = made.error_mag
    low, high = made.offset_mag - error, made.offset_mag + error
    axes.fill_between(made.colour_mag, low, high, color="#2c6e9e", alpha=0.25, lw=0)
    axes.plot(made.colour_mag, made.offset_mag, color="#2c6e9e", label="relation")
    axes.set(ylabel=f"{made.target.name} - {made.base}, mag")
    axes.legend(loc="upper right", frameon=False)


def _draw_residuals(axes: Axes, made: Relation) -> None:
    x, y, size = _spectra(made)
    residual = y - np.interp(x, made.colour_mag, made.offset_mag)
    axes.scatter(x, residual, s=size, color="#b9c4cc", lw=0)
    for sign in (-1.0, 1.0):
        axes.plot(made.colour_mag, sign * made.error_mag, color="#2c6e9e", lw=1.0)
    reach = 3.0 * float(np.quantile(made.error_mag, 0.9, method="inverted_cdf"))
    axes.set(xlabel=f"{'-'.join(made.colour)}, mag", ylabel="residual, mag", ylim=(-reach, reach))


def _spectra(made: Relation) -> tuple[Any, Any, Any]:
    """Return colour, offset and size of the point of each spectrum."""
    first, second = (synthetic_magnitudes(shipped(band)) for band in made.colour)
    offset = synthetic_magnitudes(made.target) - synthetic_magnitudes(shipped(made.base))
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
