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

    from starcat.catalog.ingest import Ingested
    from starcat.catalog.store.reading import ingest
    from starcat.database.diff import Difference, diff
    from starcat.database.verify import Verification, verify
    from starcat.errors import StarcatError
    from starcat.frames.calibration.calibrate import CalibratedFrame, Calibration
    from starcat.frames.calibration.files import calibrate
    from starcat.frames.calibration.fit import Fit, Trial
    from starcat.frames.calibration.learn import Learnt, learn
    from starcat.frames.images.batch import read_frames
    from starcat.frames.images.solve_files import identify_file
    from starcat.frames.planning.choice import StageOfLimits
    from starcat.frames.planning.plan import plan
    from starcat.frames.planning.plan_result import Expected, Plan
    from starcat.frames.sky.in_time import BodyInFrame, SkyInTime, sky_in_time, with_planets
    from starcat.frames.sky.observer import Observer
    from starcat.geometry.camera import Camera
    from starcat.geometry.distortion import Distortion
    from starcat.matcher.batch import BatchResult
    from starcat.matcher.centroids import MeasuredFrame
    from starcat.matcher.database import MatcherDatabase
    from starcat.matcher.frame_shape import FrameShape
    from starcat.matcher.matcher import Matcher
    from starcat.matcher.options import IdentifyOptions
    from starcat.matcher.refusal import Refusal
    from starcat.matcher.result import MatchResult
    from starcat.matcher.settings import Settings, TriangleOrder
    from starcat.matcher.stars import MatchedStars
    from starcat.matcher.tracking import Tracker
    from starcat.pipeline.build import Built, build
    from starcat.pipeline.report.report import CoverageReport
    from starcat.pipeline.simulation.simulate import SimulatedFrame, simulate
    from starcat.pipeline.specs.build_spec import BuildSpec
    from starcat.pipeline.specs.reading import preset, read_spec
    from starcat.pipeline.starter import Starter, init
    from starcat.query.connection import Connection, Database, connect
    from starcat.query.connection import open_for_query as open  # noqa: A004 - as numpy, gzip and PIL have it
    from starcat.query.result import QueryResult
    from starcat.query.session import Limits
    from starcat.ship.exchange.export import Exported, export
    from starcat.ship.exchange.onboard import ExportedImage
    from starcat.ship.exchange.solvers.write import ExportedSolver
    from starcat.ship.releases.lockfile import pull
    from starcat.ship.releases.publishing import Published, publish
    from starcat.ship.releases.pulling import Pulled

__all__ = [
    "BatchResult",
    "BodyInFrame",
    "BuildSpec",
    "Built",
    "CalibratedFrame",
    "Calibration",
    "Camera",
    "Connection",
    "CoverageReport",
    "Database",
    "Difference",
    "Distortion",
    "Expected",
    "Exported",
    "ExportedImage",
    "ExportedSolver",
    "Fit",
    "FrameShape",
    "IdentifyOptions",
    "Ingested",
    "Learnt",
    "Limits",
    "MatchResult",
    "MatchedStars",
    "Matcher",
    "MatcherDatabase",
    "MeasuredFrame",
    "Observer",
    "Plan",
    "Published",
    "Pulled",
    "QueryResult",
    "Refusal",
    "Settings",
    "SimulatedFrame",
    "SkyInTime",
    "StageOfLimits",
    "StarcatError",
    "Starter",
    "Tracker",
    "Trial",
    "TriangleOrder",
    "Verification",
    "__version__",
    "build",
    "calibrate",
    "connect",
    "diff",
    "export",
    "identify_file",
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
    "with_planets",
]

_HOMES = {
    "BatchResult": ("starcat.matcher.batch", "BatchResult"),
    "BodyInFrame": ("starcat.frames.sky.in_time", "BodyInFrame"),
    "BuildSpec": ("starcat.pipeline.specs.build_spec", "BuildSpec"),
    "Built": ("starcat.pipeline.build", "Built"),
    "CalibratedFrame": ("starcat.frames.calibration.calibrate", "CalibratedFrame"),
    "Calibration": ("starcat.frames.calibration.calibrate", "Calibration"),
    "Camera": ("starcat.geometry.camera", "Camera"),
    "Connection": ("starcat.query.connection", "Connection"),
    "CoverageReport": ("starcat.pipeline.report.report", "CoverageReport"),
    "Database": ("starcat.query.connection", "Database"),
    "Difference": ("starcat.database.diff", "Difference"),
    "Distortion": ("starcat.geometry.distortion", "Distortion"),
    "Expected": ("starcat.frames.planning.plan_result", "Expected"),
    "Exported": ("starcat.ship.exchange.export", "Exported"),
    "ExportedImage": ("starcat.ship.exchange.onboard", "ExportedImage"),
    "ExportedSolver": ("starcat.ship.exchange.solvers.write", "ExportedSolver"),
    "Fit": ("starcat.frames.calibration.fit", "Fit"),
    "IdentifyOptions": ("starcat.matcher.options", "IdentifyOptions"),
    "Ingested": ("starcat.catalog.ingest", "Ingested"),
    "Learnt": ("starcat.frames.calibration.learn", "Learnt"),
    "Limits": ("starcat.query.session", "Limits"),
    "MatchResult": ("starcat.matcher.result", "MatchResult"),
    "FrameShape": ("starcat.matcher.frame_shape", "FrameShape"),
    "MatchedStars": ("starcat.matcher.stars", "MatchedStars"),
    "Matcher": ("starcat.matcher.matcher", "Matcher"),
    "MatcherDatabase": ("starcat.matcher.database", "MatcherDatabase"),
    "MeasuredFrame": ("starcat.matcher.centroids", "MeasuredFrame"),
    "Observer": ("starcat.frames.sky.observer", "Observer"),
    "Plan": ("starcat.frames.planning.plan_result", "Plan"),
    "Published": ("starcat.ship.releases.publishing", "Published"),
    "Pulled": ("starcat.ship.releases.pulling", "Pulled"),
    "QueryResult": ("starcat.query.result", "QueryResult"),
    "Refusal": ("starcat.matcher.refusal", "Refusal"),
    "Settings": ("starcat.matcher.settings", "Settings"),
    "SimulatedFrame": ("starcat.pipeline.simulation.simulate", "SimulatedFrame"),
    "SkyInTime": ("starcat.frames.sky.in_time", "SkyInTime"),
    "StageOfLimits": ("starcat.frames.planning.choice", "StageOfLimits"),
    "StarcatError": ("starcat.errors", "StarcatError"),
    "Starter": ("starcat.pipeline.starter", "Starter"),
    "Tracker": ("starcat.matcher.tracking", "Tracker"),
    "Trial": ("starcat.frames.calibration.fit", "Trial"),
    "TriangleOrder": ("starcat.matcher.settings", "TriangleOrder"),
    "Verification": ("starcat.database.verify", "Verification"),
    "build": ("starcat.pipeline.build", "build"),
    "calibrate": ("starcat.frames.calibration.files", "calibrate"),
    "connect": ("starcat.query.connection", "connect"),
    "diff": ("starcat.database.diff", "diff"),
    "export": ("starcat.ship.exchange.export", "export"),
    "identify_file": ("starcat.frames.images.solve_files", "identify_file"),
    "ingest": ("starcat.catalog.store.reading", "ingest"),
    "init": ("starcat.pipeline.starter", "init"),
    "learn": ("starcat.frames.calibration.learn", "learn"),
    "open": ("starcat.query.connection", "open_for_query"),
    "plan": ("starcat.frames.planning.plan", "plan"),
    "preset": ("starcat.pipeline.specs.reading", "preset"),
    "publish": ("starcat.ship.releases.publishing", "publish"),
    "pull": ("starcat.ship.releases.lockfile", "pull"),
    "read_frames": ("starcat.frames.images.batch", "read_frames"),
    "read_spec": ("starcat.pipeline.specs.reading", "read_spec"),
    "simulate": ("starcat.pipeline.simulation.simulate", "simulate"),
    "sky_in_time": ("starcat.frames.sky.in_time", "sky_in_time"),
    "verify": ("starcat.database.verify", "verify"),
    "with_planets": ("starcat.frames.sky.in_time", "with_planets"),
}
"""Module that defines each public name, and its name there."""


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used (PEP 562)."""
    if name not in _HOMES:
        from starcat.errors import suggest

        hint = "" if name.startswith("_") else suggest(name, __all__).strip()
        end = f"; {hint}" if hint else ""
        raise AttributeError(f"module 'starcat' has no attribute {name!r}{end}")
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
