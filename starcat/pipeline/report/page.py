"""The report as one HTML page that needs no other file and no network."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any

from starcat.pipeline.specs.build_spec import CameraSpec

STYLE = """
:root {
  color-scheme: light dark;
  --paper: #fff; --ink: #14181b; --line: #d5dbe0; --soft: #5b6770; --head: #f1f4f6;
}
@media (prefers-color-scheme: dark) {
  :root { --paper: #14181b; --ink: #dbe3e9; --line: #3a444c; --soft: #a3b0ba; --head: #20272d; }
}
body {
  font: 15px/1.5 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem;
  background: var(--paper); color: var(--ink);
}
h1 { margin-bottom: 0; }
h2 { margin: 2.2rem 0 0.5rem; font-size: 1.2rem; }
p.lead { color: var(--soft); margin-top: 0.2rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; margin: 0.5rem 0 1rem; font-size: 0.92rem; }
caption { text-align: left; color: var(--soft); padding-bottom: 0.25rem; }
th, td { padding: 0.2rem 0.8rem 0.2rem 0.4rem; border-bottom: 1px solid var(--line); }
th { background: var(--head); text-align: left; font-weight: 600; }
td.number, th.number { text-align: right; font-variant-numeric: tabular-nums; }
code { font-size: 0.85em; overflow-wrap: anywhere; }
td.digest { font: 0.8em/1.4 monospace; width: 33ch; min-width: 33ch; overflow-wrap: anywhere; }
pre { background: var(--head); padding: 0.8rem; overflow-x: auto; font-size: 0.85rem; }
figure { margin: 1rem 0; }
figure img { max-width: 100%; height: auto; background: var(--paper); }
.warning { border-left: 4px solid #d1495b; padding: 0.3rem 0.8rem; background: var(--head); }
"""

_ALT = {
    "coverage_map": "All-sky map in Mollweide's projection: guide stars in the field of view",
    "attitude_error": "All-sky map in Mollweide's projection: attitude error across the boresight",
    "coverage_histogram": "Histogram: how many fields hold how many guide stars",
    "stars_by_magnitude": "Bar chart: records read and guide stars by magnitude",
}


def report_page(
    content: Mapping[str, Any], plots: Mapping[str, bytes], more: Sequence[str] = ()
) -> str:
    """Return the report of a build as an HTML page, with more sections after the selection."""
    title = f"{content['name']}-{content['version']}"
    parts = [
        f"<h1>{escape(title)}</h1>",
        f'<p class="lead">{escape(content["description"])}</p>',
        *(f'<p class="warning">Warning: {escape(text)}.</p>' for text in content["warnings"]),
        _summary(content),
        "<h2>Sources</h2>",
        *(_source(source, content["reasons"]) for source in content["sources"]),
        "<h2>Selection</h2>",
        _filters(content["filters"]),
        *([_neighbours(content["neighbours"])] if "neighbours" in content else []),
        figure(_ALT["stars_by_magnitude"], plots["stars_by_magnitude"]),
        *more,
        "<h2>Coverage</h2>",
        _coverage(content["coverage"]),
        figure(_ALT["coverage_map"], plots["coverage_map"]),
        figure(_ALT["coverage_histogram"], plots["coverage_histogram"]),
        _evenness(content["coverage"]),
        figure(_ALT["attitude_error"], plots["attitude_error"]),
        "<h2>Products</h2>",
        _products(content["products"], content["database_bytes"]),
        "<h2>Self-test</h2>",
        _self_test(content["self_test"]),
        "<h2>Spec</h2>",
        f"<pre>{escape(json.dumps(content['spec'], indent=2, ensure_ascii=False))}</pre>",
        "<h2>Made by</h2>",
        table("", ("software", "version"), sorted(content["software"].items())),
        "<p>Seconds and memory of each build are in the file <code>"
        f"{escape(title)}.build.json</code> beside the database: they differ from run to run.</p>",
    ]
    return html_page(f"{title}: build report", parts)


def html_page(title: str, parts: Iterable[str], more_style: str = "") -> str:
    """Return a page of parts that are HTML."""
    body = "\n".join(parts)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE}{more_style}</style>\n</head>\n"
        f"<body>\n{body}\n</body>\n</html>\n"
    )


def table(
    caption: str, columns: Sequence[str], rows: Iterable[Sequence[Any]], numbers: Sequence[int] = ()
) -> str:
    """Return a table."""
    kinds = [' class="number"' if k in numbers else "" for k in range(len(columns))]
    head = "".join(
        f'<th scope="col"{kind}>{escape(name)}</th>'
        for name, kind in zip(columns, kinds, strict=True)
    )
    lines = []
    for row in rows:
        cells = (
            f"<td{_class(cell, kind)}>{escape(_text(cell))}</td>"
            for cell, kind in zip(row, kinds, strict=True)
        )
        lines.append(f"<tr>{''.join(cells)}</tr>")
    above = f"<caption>{escape(caption)}</caption>\n" if caption else ""
    heads = f"<thead><tr>{head}</tr></thead>\n" if any(columns) else ""
    body = "\n".join(lines)
    return f'<div class="scroll"><table>\n{above}{heads}<tbody>\n{body}\n</tbody></table></div>'


def _text(cell: Any) -> str:
    if isinstance(cell, bool) or not isinstance(cell, int | float):
        return str(cell)
    return f"{cell:,}" if isinstance(cell, int) else f"{cell:,.4g}"


def _class(cell: Any, kind: str) -> str:
    is_digest = isinstance(cell, str) and len(cell) == 64 and cell.isalnum()
    return ' class="digest"' if is_digest else kind


def figure(alt: str, svg: bytes) -> str:
    """Return a drawing within the page."""
    data = base64.b64encode(svg).decode()
    return f'<figure><img alt="{escape(alt)}" src="data:image/svg+xml;base64,{data}"></figure>'


def _summary(content: Mapping[str, Any]) -> str:
    camera = CameraSpec.model_validate(content["spec"]["camera"]).camera()
    stars = content["products"]["stars"]["rows"]
    clean = content["self_test"][0]
    rows = [
        ("guide stars", f"{stars:,}"),
        ("positions", f"{content['frame']}, epoch J{content['epoch_jyear']:g}"),
        *_validity(content.get("validity")),
        ("camera", camera.in_words),
        ("fewest guide stars in a field", f"{content['coverage']['stars']['minimum']:,}"),
        (
            "identified in the self-test",
            f"{clean['identified_share']:.2%} of all pointings, "
            f"{clean['share_of_identifiable']:.2%} of those with at least 4 stars",
        ),
    ]
    return table("", ("", ""), rows)


def _validity(validity: Mapping[str, Any] | None) -> list[tuple[str, str]]:
    if validity is None:
        return []
    worst = ", ".join(
        f"{star['designation']} {star['drift_arcsec']:.2f}" for star in validity["worst"]
    )
    error = validity["largest_error_arcsec"]
    return [
        ("they hold", f"from J{validity['begin_jyear']:g} to J{validity['end_jyear']:g}"),
        ("stars drift, arcsec", f"median {validity['median_drift_arcsec']:.2f}; worst: {worst}"),
        ("with a release at the middle", f"at most {validity['reissued_worst_arcsec']:.2f} arcsec"),
        ("largest error of a position", "not known" if error is None else f"{error:.3f} arcsec"),
        ("stars without a motion", f"{validity['stars_without_motion']:,}"),
    ]


def _source(source: Mapping[str, Any], reasons: Mapping[str, str]) -> str:
    rows = [("read", "", source["rows_read"]), ("kept", "", source["kept"])]
    rows += [(name, reasons[name], count) for name, count in source["rejected"].items()]
    if "joined" in source:
        kinds = {"motions": "motion", "photometry": "magnitude partly"}
        what = kinds.get(source["role"], "amplitude")
        rows.append(("joined", f"stars whose {what} is from here", source["joined"]))
    for name, moved_arcsec in source.get("moved_arcsec", {}).items():
        rows.append((f"{name} movement", "of these stars, arcsec", moved_arcsec))
    files = [(f["name"], f["bytes"], f["rows"], f["sha256"]) for f in source["files"]]
    name = f"{source['source']} ({source['role']})"
    return "\n".join(
        (
            table(f"{name}: files", ("file", "bytes", "records", "SHA-256"), files, (1, 2)),
            table(f"{name}: records", ("verdict", "meaning", "records"), rows, (2,)),
        )
    )


def _filters(filters: Sequence[Mapping[str, Any]]) -> str:
    rows = [
        (
            step["step"],
            step["stars"],
            step["median_per_field"],
            step["min_per_field"],
            f"{step['share_below_4']:.2%}",
        )
        for step in filters
    ]
    heads = ("after", "stars", "median a field", "fewest in a field", "fields below 4")
    return table("Stars in the fields of the tiling after each filter", heads, rows, (1, 2, 3, 4))


def _neighbours(tally: Mapping[str, int]) -> str:
    return (
        f"<p>[selection.neighbours] keeps {tally['regained']:,} stars that the separation rule of "
        f"[selection.doubles] would leave out, and leaves out {tally['lost']:,} that it would "
        f"keep. The light of {tally['absorbed']:,} stars is in merged ones.</p>"
    )


def _coverage(coverage: Mapping[str, Any]) -> str:
    names = ("minimum", "one_percent", "median", "mean", "maximum")
    rows = [
        (kind, *(_rounded(coverage[kind][name]) for name in names))
        for kind in ("stars", "pairs", "triangles")
    ]
    heads = ("in a field", "fewest", "1 % of the fields", "median", "mean", "most")
    worst, tiling = coverage["worst_field"], coverage["tiling"]
    reach = "Some directions lie outside of it" if tiling["holes"] else "No direction lies outside"
    return (
        table(f"{coverage['fields']:,} fields of the tiling", heads, rows, range(1, 6))
        + f"\n<p>The field with the fewest stars is boresight {worst['boresight']:,} at right "
        f"ascension {worst['ra_deg']:.3f}°, declination {worst['dec_deg']:+.3f}°. At any roll a "
        f"field reaches {tiling['tile_radius_deg']:.3f}° from its boresight. {reach}: the "
        f"direction farthest from all boresights is {tiling['covering_radius_deg']:.3f}° away from "
        "the nearest.</p>"
    )


def _evenness(coverage: Mapping[str, Any]) -> str:
    errors = coverage["attitude_error_arcsec_per_px"]
    names = ("median", "one_percent", "worst")
    rows = [
        (f"{axis} the boresight", *(_rounded(errors[axis][name]) for name in names))
        for axis in ("across", "about")
    ]
    heads = ("arcsec for 1 px of noise", "median", "worst 1 % of the fields", "worst")
    return (
        table("Attitude error that the stars of a field allow", heads, rows, range(1, 4))
        + f"\n<p>The entropy of the stars is {coverage['entropy']:.4f} over "
        f"{coverage['entropy_cells']:,} cells of the size of a field; it is 1 where all have as "
        "many.</p>"
    )


def _rounded(value: float | None) -> str:
    if value is None:
        return "no attitude"
    return f"{value:,.1f}" if isinstance(value, float) else f"{value:,}"


def _products(products: Mapping[str, Mapping[str, Any]], database_bytes: int) -> str:
    rows: list[Sequence[Any]] = [
        (name, facts["schema"], facts["rows"], facts["bytes"], facts["content_sha256"])
        for name, facts in products.items()
    ]
    rows.append(("database.h5", "", "", database_bytes, ""))
    heads = ("product", "schema", "rows", "bytes", "SHA-256 of the content")
    return table("", heads, rows, (2, 3))


def _self_test(rates: Sequence[Mapping[str, Any]]) -> str:
    names = (
        "name", "noise_px", "noise_mag", "drop_probability", "false_stars", "frames",
        "identifiable", "identified", "wrong", "median_residual_arcsec",
    )  # fmt: skip
    rows = [
        (
            *("" if rate[name] is None else rate[name] for name in names),
            f"{rate['identified_share']:.2%}",
            f"{rate['share_of_identifiable']:.2%}",
        )
        for rate in rates
    ]
    heads = (
        "fields", "noise, px", "noise, mag", "missing", "false", "tried", "4 stars or more",
        "right", "wrong", "residual, arcsec", "of all pointings", "of 4 stars or more",
    )  # fmt: skip
    return table("Simulated fields", heads, rows, range(1, 12))
