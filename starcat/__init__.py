"""starcat: guide-star databases for star trackers, built from star catalogs.

>>> import starcat
>>> starcat.preset("gaia-12deg")
<BuildSpec gaia-12deg-1.0.0: gaia to 6 mag, 1024 x 1024 px, 12 x 12 deg>

The public names are listed in ``__all__``. Each is imported when it is first used, so that
``import starcat`` is fast, and a program that only matches needs numpy and h5py alone. The
packages that define them are described in ``docs/house.md`` and may change.
"""

from __future__ import annotations

from starcat.version import __version__, mixed_with

if _mixed := mixed_with():
    raise ImportError(_mixed)

TYPE_CHECKING = False  # type checkers take this as True; typing is not imported
if TYPE_CHECKING:
    from typing import Any

    from starcat.api.artifact import connect
    from starcat.api.artifact import open_for_query as open  # noqa: A004 - as numpy, gzip and PIL have it
    from starcat.api.functions import (
        build,
        calibrate,
        diff,
        export,
        ingest,
        init,
        learn,
        plan,
        publish,
        pull,
        read_frames,
        simulate,
        verify,
    )  # fmt: skip
    from starcat.api.matcher import Matcher
    from starcat.errors import StarcatError
    from starcat.geometry.camera import Camera
    from starcat.matcher.tracking import Tracker
    from starcat.planning.plan import Plan
    from starcat.sky.in_time import identify_in_time, sky_in_time
    from starcat.sky.observer import Observer
    from starcat.specs.reading import preset, read_spec

__all__ = [
    "Camera",
    "Matcher",
    "Observer",
    "Plan",
    "StarcatError",
    "Tracker",
    "__version__",
    "build",
    "calibrate",
    "connect",
    "diff",
    "export",
    "identify_in_time",
    "ingest",
    "init",
    "learn",
    "open",
    "plan",
    "preset",
    "publish",
    "pull",
    "read_frames",
    "read_spec",
    "simulate",
    "sky_in_time",
    "verify",
]

_HOMES = {
    "Camera": ("starcat.geometry.camera", "Camera"),
    "Matcher": ("starcat.api.matcher", "Matcher"),
    "Observer": ("starcat.sky.observer", "Observer"),
    "Plan": ("starcat.planning.plan", "Plan"),
    "StarcatError": ("starcat.errors", "StarcatError"),
    "Tracker": ("starcat.matcher.tracking", "Tracker"),
    "build": ("starcat.api.functions", "build"),
    "calibrate": ("starcat.api.functions", "calibrate"),
    "connect": ("starcat.api.artifact", "connect"),
    "diff": ("starcat.api.functions", "diff"),
    "export": ("starcat.api.functions", "export"),
    "identify_in_time": ("starcat.sky.in_time", "identify_in_time"),
    "ingest": ("starcat.api.functions", "ingest"),
    "init": ("starcat.api.functions", "init"),
    "learn": ("starcat.api.functions", "learn"),
    "open": ("starcat.api.artifact", "open_for_query"),
    "plan": ("starcat.api.functions", "plan"),
    "preset": ("starcat.specs.reading", "preset"),
    "publish": ("starcat.api.functions", "publish"),
    "pull": ("starcat.api.functions", "pull"),
    "read_frames": ("starcat.api.functions", "read_frames"),
    "read_spec": ("starcat.specs.reading", "read_spec"),
    "simulate": ("starcat.api.functions", "simulate"),
    "sky_in_time": ("starcat.sky.in_time", "sky_in_time"),
    "verify": ("starcat.api.functions", "verify"),
}
"""Module that defines each public name, and its name there."""


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module 'starcat' has no attribute {name!r}")
    import logging
    from importlib import import_module

    # A program that needs the library's messages sets up logging itself.
    logging.getLogger(__name__).addHandler(logging.NullHandler())
    module, attribute = _HOMES[name]
    try:
        found = globals()[name] = getattr(import_module(module), attribute)
    except ModuleNotFoundError as error:
        from starcat.version import missing_packages

        text = missing_packages(f"starcat.{name}", error)
        raise ModuleNotFoundError(text, name=error.name) from error
    return found


def __dir__() -> list[str]:
    """List the public names."""
    return sorted(__all__)
