"""The plot of a plan over time."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from starcat.frames.planning.plan_result import Plan
from starcat.pipeline.report.plots import STYLE, headline
from starcat.storage.figures import check_kind, own_style, write_figure

_COLOURS = {"Sun": "#d1495b", "Moon": "#5b6770", "Earth": "#2c6e9e"}


def draw_plan(plan: Plan, path: Path) -> None:
    """Draw acquisition, errors, number of stars and angles of bodies as PNG or SVG."""
    from matplotlib.figure import Figure

    check_kind(path)
    times = plan.attitudes.times
    x = np.arange(1, len(plan) + 1) if times is None else np.array(times)
    with own_style(STYLE):
        figure = Figure(figsize=(10.0, 9.0))
        usable = int(plan.is_usable.sum())
        below = f"{len(plan):,} attitudes, {usable:,} usable; gaps are shaded"
        headline(figure, f"Plan: {plan.database.name}, {plan.camera.in_words}", below)
        axes = [figure.add_axes((0.09, 0.70 - 0.21 * k, 0.88, 0.17)) for k in range(4)]
        mark = "o" if len(plan) < 3 else None
        axes[0].plot(x, plan.acquisition, color="#2c6e9e", marker=mark)
        axes[0].set(ylim=(-0.03, 1.03), ylabel="acquisition")
        for k, name in enumerate("xyz"):
            error = np.where(np.isfinite(plan.error_arcsec[:, k]), plan.error_arcsec[:, k], np.nan)
            axes[1].plot(x, error, label=f"about {name}", marker=mark)
        axes[1].set(yscale="log", ylabel="error, arcsec")
        axes[2].plot(x, plan.stars_expected, color="#2c6e9e", marker=mark)
        axes[2].set(ylim=(0, None), ylabel="stars")
        for name in (name for name in _COLOURS if name in plan.angles_deg):
            angle, colour = plan.angles_deg[name], _COLOURS[name]
            line = axes[3].plot(x, angle, color=colour, label=name, marker=mark)
            if name in plan.expected.keep_out_deg:
                limit = plan.expected.keep_out_deg[name]
                axes[3].axhline(limit, color=line[0].get_color(), ls="--", lw=0.8)
        axes[3].set(ylabel="angle, deg", xlabel="attitude" if times is None else "UTC")
        for each in (axes[1], *axes[3:][: bool(plan.angles_deg)]):
            each.legend(loc="upper right", frameon=False, ncols=3)
        for each in axes:
            each.fill_between(
                x, 0, 1, where=~plan.is_usable, step="mid", color="#b9c4cc", alpha=0.5, lw=0,
                transform=each.get_xaxis_transform(),
            )  # fmt: skip
        write_figure(figure, path)
