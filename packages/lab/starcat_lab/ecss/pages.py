"""The report of a star sensor: tables for HTML, Markdown and CSV, and one page to tick."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING, Any

from starcat.pipeline.report import STYLE, figure, headline, html_page
from starcat.storage import own_style
from starcat_lab.ecss.trials import NOMINAL, WORST
from starcat_lab.report.files import html_of, markdown_of
from starcat_lab.report.plots import COLOURS
from starcat_lab.report.tables import ReportTable

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Content = Mapping[str, Any]

STANDARD = "ECSS-E-ST-60-20C"
CLAUSES = {"bias": "3.2.8.2", "fov": "3.2.8.3", "pixel": "3.2.8.4"}
"""Definitions of Rev. 1 (2008) that were checked; of other subjects only the name is given."""

_AXES = ("x", "y", "z")


def sensor_tables(content: Content) -> dict[str, ReportTable]:
    """Return all tables by the name of their CSV file, the page to tick first."""
    tables = {
        "checklist": _checklist(content),
        "errors": _errors(content),
        "bias": _bias(content),
        "noise_by_rate": _rates(content),
        "noise_by_magnitude": _magnitudes(content),
        "acquisition": _acquisition(content),
        "robustness": _robustness(content),
        "sky": _sky(content),
        "simulation": _simulation(content),
    }
    return {name: report_table for name, report_table in tables.items() if report_table.rows}


def _table(
    title: str,
    heads: Sequence[str],
    rows: Sequence[Sequence[str]],
    numbers: Sequence[int],
    notes: Sequence[str] = (),
) -> ReportTable:
    return ReportTable(title, tuple(heads), tuple(map(tuple, rows)), tuple(numbers), tuple(notes))


def number(value: float | None) -> str:
    """Return a figure to three digits; empty for None."""
    return "" if value is None or value != value else f"{value:.3g}"


def _triple(values: Sequence[float] | None) -> list[str]:
    return [number(v) for v in values] if values else ["", "", ""]


def _share(share: Content) -> str:
    if not share["count"]:
        return "not tried"
    low, high = share["low_percent"], share["high_percent"]
    return f"{share['percent']:.2f} % [{low:.2f}, {high:.2f}], {share['hits']} of {share['count']}"


def _row(content: Content, name: str) -> Content | None:
    return next((row for row in content["budget"] if row["name"] == name), None)


def _said(row: Content | None, key: str = "at_confidence_arcsec") -> str:
    return "no frame was right" if row is None else " / ".join(_triple(row[key])) + " arcsec"


def _checklist(content: Content) -> ReportTable:
    stated, bias = f"{100.0 * content['confidence']:g} %", content["bias"]
    false, sky = content["false_attitude"], content["sky"]
    first = content["trials"][NOMINAL]["first_frame"]
    about = f"x / y / z at {stated}"
    rows = [
        ("bias", CLAUSES["bias"], "mean about x / y / z", _said(bias, "mean_arcsec"), "bias"),
        ("thermo-elastic error", "", "as stated, not simulated",
         _said(bias, "thermo_elastic_arcsec"), "bias"),
        *((row["label"], CLAUSES.get(name, ""), about, _said(row), "errors")
          for name in ("fov", "pixel", "temporal", "aberration", "all")
          if (row := _row(content, name))),
        ("noise against magnitude and rate", "", "tables and plot", "below", "noise_by_magnitude"),
        ("acquisition from lost in space", "", "first frame right", _share(first), "acquisition"),
        ("false attitude", "", "frames answered with one", _share(false), "robustness"),
        ("false attitude, bound", "", "largest that the matcher accepts in a frame",
         number(false["bound_of_a_frame"]), "robustness"),
        ("availability, worst 1 % of the sky", "", "first frame right",
         _share(sky["worst_first_frame"]), "sky"),
        *((f"robustness: {name}", "", "first frame right", _share(trial["first_frame"]),
           "robustness")
          for name, trial in content["trials"].items() if name not in (NOMINAL, WORST)),
    ]  # fmt: skip
    heads = ("subject", "clause (Rev. 1)", "figure", "value", "table", "reviewed")
    return _table("To tick", heads, [(*row, "\u2610") for row in rows], (), (
        f"Clauses are those of {STANDARD} Rev. 1 (2008) whose text was read; the others are for "
        "the reviewer to fill in from the revision that the project applies.",
    ))  # fmt: skip


def _errors(content: Content) -> ReportTable:
    stated = f"{100.0 * content['confidence']:g} %"
    rows = [
        (
            row["label"],
            *_triple(row["sigma_arcsec"]),
            "{:.2f} to {:.2f}".format(*row["interval"]),
            *_triple(row["at_confidence_arcsec"]),
            *_triple(row["largest_arcsec"]),
        )
        for row in content["budget"]
    ]
    whole, noise = _row(content, "all"), _row(content, "temporal")
    notes = ["Without the mean, which is the bias. The interval (95 %, chi-square) is a factor "
             f"of \u03c3; at {stated}: {content['sigmas']:.3g} \u03c3."]  # fmt: skip
    if whole and noise:
        notes += [
            "The root of the sum of squares of the contributors is "
            f"{_said(whole, 'root_sum_square_arcsec')}; the temporal noise in closed form is "
            f"{_said(noise, 'closed_form_arcsec')}."
        ]
    heads = ["contributor", *(f"\u03c3 {a}, arcsec" for a in _AXES), "interval"]
    heads += [f"{a} at {stated}, arcsec" for a in _AXES]
    heads += [f"largest {a}" for a in _AXES]
    return _table(
        "Errors about x, y (across the boresight) and z", heads, rows, range(1, 11), notes
    )


def _bias(content: Content) -> ReportTable:
    bias = content["bias"]
    keys = {
        "mean error, measured": "mean_arcsec",
        "half of its interval of 95 %": "half_interval_arcsec",
        "closed form: alignment, principal point": "closed_form_arcsec",
        "thermo-elastic error, as stated": "thermo_elastic_arcsec",
    }
    rows = [(label, *_triple(bias[key])) for label, key in keys.items()] if bias else []
    heads = ("", *(f"{a}, arcsec" for a in _AXES))
    notes = ("The mean over the sky of an unknown focal length and distortion is in it too.",)
    return _table("Bias", heads, rows, (1, 2, 3), notes if bias else ())


def _rates(content: Content) -> ReportTable:
    rows = []
    for noise in content["temporal"]:
        trial = content["trials"][noise["trial"]]
        sigma, factor = noise.get("sigma_arcsec"), noise.get("interval")
        interval = "{:.2f} to {:.2f}".format(*factor) if factor else ""
        rows.append(
            (f"{noise['rate_deg_s']:g}", _share(trial["first_frame"]), *_triple(sigma), interval)
        )
    heads = (
        "rate, deg/s",
        "first frame right",
        *(f"\u03c3 {a}, arcsec" for a in _AXES),
        "interval",
    )
    return _table("Temporal noise of the attitude by rate", heads, rows, (0, 2, 3, 4))


def _magnitudes(content: Content) -> ReportTable:
    stars = content["stars"]
    rates = list(dict.fromkeys(star["rate_deg_s"] for star in stars))
    rows = []
    for mag in dict.fromkeys(star["mag"] for star in stars):
        same_mag = [star for star in stars if star["mag"] == mag]
        cells = [f"{mag:g}", number(same_mag[0]["closed_form_arcsec"])]
        for star in same_mag:
            cells += [number(star["noise_arcsec"]), f"{100.0 * star['found'] / star['count']:.1f}"]
        rows.append(tuple(cells))
    heads = ["magnitude", "closed form at rest, arcsec"]
    heads += [h for r in rates for h in (f"{r:g} deg/s, arcsec", "found, %")]
    notes = (
        "Standard deviation of a star's centroid on one axis, between frames. The closed form "
        "knows neither saturation nor the choice of lucky stars near the threshold.",
    )
    return _table("Noise of a star by magnitude and rate", heads, rows, range(len(heads)), notes)


def _acquisition(content: Content) -> ReportTable:
    rows = [
        (str(acquisition["frames"]), number(acquisition["time_s"]), _share(acquisition))
        for acquisition in content["acquisition"]
    ]
    heads = ("within frames", "time, s", "right attitude, interval of 95 % (Wilson)")
    notes = ("Time: frames at the update rate, one exposure, and the processing time as stated.",)
    return _table("Acquisition from lost in space, all over the sky", heads, rows, (0, 1), notes)


def _robustness(content: Content) -> ReportTable:
    rows = [
        (
            name,
            number(trial["guide_stars_median"]),
            _share(trial["first_frame"]),
            _share(trial["false"]),
        )
        for name, trial in content["trials"].items()
    ]
    false = content["false_attitude"]
    rows.append(("all frames", "", "", _share(false)))
    notes = (
        "A false attitude is off by more than twice the matcher's reach at a corner of the frame. "
        f"Bounds that the matcher stated: at most {number(false['largest_stated'])} in a frame, "
        f"{number(false['sum_stated'])} in sum.",
    )
    heads = ("condition", "guide stars (median)", "first frame right", "false attitudes of frames")
    return _table("Acquisition under conditions", heads, rows, (1,), notes)


def _sky(content: Content) -> ReportTable:
    sky = content["sky"]
    few, middle = sky["guide_stars"], sky["median_arcsec"]
    worst = sky["worst_one_percent_arcsec"]
    rows = [
        ("guide stars: fewest, 1 %, median", " / ".join(number(v) for v in few.values())),
        ("fields with fewer than 4 guide stars", _share(sky["below_four"])),
        ("noise across / about, median, closed form",
         f"{number(middle[0])} / {number(middle[1])} arcsec"),
        ("the same, exceeded in 1 % of the sky",
         f"{number(worst[0]) or 'none'} / {number(worst[1]) or 'none'} arcsec"),
        ("first frame right, all over the sky", _share(content["trials"][NOMINAL]["first_frame"])),
        ("first frame right, worst 1 % of the sky", _share(sky["worst_first_frame"])),
    ]  # fmt: skip
    measured = content["trials"][WORST]["temporal"]
    if measured:
        rows.append(
            ("temporal noise \u03c3 x / y / z there, measured", _said(measured, "sigma_arcsec"))
        )
    return _table(f"Availability over {sky['boresights']:,} boresights", ("", ""), rows, ())


def _simulation(content: Content) -> ReportTable:
    rows = [
        ("database", content["artifact"]),
        ("camera", content["camera"]),
        ("method", content["method"]),
        ("frames from electrons to attitude", f"{content['frames']:,}"),
        ("seed", str(content["seed"])),
        ("stars that shine", content["sky_in_words"]),
        ("simulated", "light of stars on pixels, shot noise, dark current, PRNU, DSNU, full well, "
         "read noise, converter; detection, centroids, identification and attitude as in flight"),
        ("computed for the stars of each nominal frame", "contributors by themselves: without "
         "noise, through the same centroids and attitude"),
        ("as stated", "alignment, thermo-elastic error, processing time"),
        ("not simulated", "stray light that varies over the field, optics whose spot does, "
         "rolling shutter, compression, eclipse, fainter stars than those above"),
    ]  # fmt: skip
    return _table("What was simulated", ("", ""), rows, ())


_MORE_STYLE = """
body { max-width: 76rem; }
.rates table { font-size: 0.86rem; }
.rates td, .rates th { padding: 0.15rem 0.55rem 0.15rem 0.35rem; }
.notes { color: var(--soft); font-size: 0.9rem; }
@media print { h2 + .rates:first-of-type { break-after: page; } }
"""


def sensor_page(content: Content, plot: bytes) -> str:
    """Return the report as one HTML page."""
    title = _title(content)
    parts = [f"<h1>{escape(title)}</h1>", f'<p class="lead">{escape(_lead(content))}</p>']
    for name, report_table in sensor_tables(content).items():
        parts += [f"<h2>{escape(report_table.title)}</h2>", html_of(report_table)]
        if name == "noise_by_magnitude":
            parts.append(figure("Curves: noise of a star by magnitude, one for each rate", plot))
    parts.append(f"<h2>Sensor</h2><pre>{escape(content['sensor_toml'])}</pre>")
    return html_page(title, parts, _MORE_STYLE)


def markdown_page(content: Content) -> str:
    """Return the report as Markdown."""
    parts = [f"# {_title(content)}", _lead(content)]
    for report_table in sensor_tables(content).values():
        parts += [f"## {report_table.title}", markdown_of(report_table)]
    parts.append(f"## Sensor\n\n```toml\n{content['sensor_toml'].strip()}\n```")
    return "\n\n".join(parts) + "\n"


def _title(content: Content) -> str:
    return f"Star sensor on {content['artifact']}"


def _lead(content: Content) -> str:
    pointings = content["trials"][NOMINAL]["pointings"]
    return (
        f"Figures in the terms of {STANDARD}, of {content['frames']:,} simulated frames: starcat "
        f"evaluate {content['artifact']} --ecss SENSOR.toml --frames {pointings} --seed "
        f"{content['seed']}. It is a report of a simulation, no statement of compliance."
    )


def draw_noise(content: Content) -> Figure:
    """Draw the noise of a star against its magnitude."""
    from matplotlib.figure import Figure

    stars = content["stars"]
    with own_style(STYLE):
        figure = Figure(figsize=(7.2, 4.0))
        headline(figure, "Noise of a star by magnitude", "one axis, between frames, 1 \u03c3")
        axes = figure.add_axes((0.105, 0.13, 0.615, 0.69))
        axes.grid(axis="y", color="#e3e7ea")
        rates = dict.fromkeys(star["rate_deg_s"] for star in stars)
        for number_, rate in enumerate(rates):
            same_rate = [star for star in stars if star["rate_deg_s"] == rate]
            x, y = [star["mag"] for star in same_rate], [star["noise_arcsec"] for star in same_rate]
            axes.plot(x, y, "o-", ms=4, color=COLOURS[number_], label=f"{rate:g} deg/s")
        x = [star["mag"] for star in stars if star["rate_deg_s"] == stars[0]["rate_deg_s"]]
        y = [star["closed_form_arcsec"] for star in stars[: len(x)]]
        axes.plot(x, y, ls=(0, (4, 3)), color="#8a959d", label="closed form, at rest")
        axes.set_yscale("log")
        axes.set(xlabel="magnitude", ylabel="noise, arcsec")
        axes.legend(frameon=False, loc="upper left", bbox_to_anchor=(1.02, 1.02))
    return figure
