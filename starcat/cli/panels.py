"""Help in panels: the commands by the step of the work, many options by what they are about."""

from __future__ import annotations

from typing import Any

from typer.core import TyperCommand, TyperGroup

PANELS = {
    "Design a database": ("sources", "bands", "presets", "init", "estimate"),
    "Build it": ("fetch", "ingest", "crossmatch", "build", "rebuild"),
    "Check it": ("inspect", "verify", "coverage", "diff", "selftest", "evaluate"),
    "Use it": ("simulate", "identify", "calibrate", "learn", "methods", "sql"),
    "Ship it": ("export", "publish", "pull", "releases", "keys"),
    "Serve it": ("serve", "token"),
}
"""The commands in the order of --help."""


class WholeSummaries(TyperGroup):
    """The commands in the help, each with its first sentence and no dots for the rest."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the commands in the order of the panels."""
        return [name for names in PANELS.values() for name in names]

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write a panel for each step of the work, and a line or more a command."""
        for panel, names in PANELS.items():
            with formatter.section(panel):
                formatter.write_dl(
                    [(name, self.commands[name].get_short_help_str(limit=1000)) for name in names]
                )


OPTIONS = {
    "Search": (
        *("method", "tolerance_px", "noise_px", "noise_mag", "max_false_match_probability"),
        *("min_share", "max_steps", "time_limit_s", "prior_q", "prior_error_deg", "track"),
    ),
    "Camera": ("camera", "fov_error", "fov", "size", "flip"),
    "Pictures": (*("psf_sigma_px", "threshold", "most_spots", "plane", "bayer", "dark", "mask"),),
    "Time and place": ("time", "velocity", "orbit"),
    "Output": ("picture", "contact_sheet", "wcs", "fail_on_no_match", "ndjson", "json", "help"),
}
"""The options of 'starcat identify' by what they are about."""


class OptionsInPanels(TyperCommand):
    """A command with so many options that its help has them by `OPTIONS`."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write a panel for the arguments, and one for each group of options."""
        panel_of = {name: panel for panel, names in OPTIONS.items() for name in names}
        panels: dict[str, list[tuple[str, str]]] = {"Arguments": []}
        for param in self.get_params(ctx):
            record = param.get_help_record(ctx)
            if record is not None:
                panels.setdefault(panel_of.get(param.name or "", "Arguments"), []).append(record)
        for panel in ("Arguments", *OPTIONS):
            with formatter.section(panel):
                formatter.write_dl(panels[panel])
