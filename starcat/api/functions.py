"""The commands as Python functions.

Each function converts strings to paths, fills in defaults, and calls the same function as the
command line.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starcat.arguments import (
    check_type,
    database_path,
    path_of,
    paths_of,
    text_of_path,
    whole_number,
)
from starcat.resources import PathLike

if TYPE_CHECKING:  # an installation that only matches lacks the libraries these import
    from numpy.random import Generator
    from numpy.typing import ArrayLike

    from starcat.api.artifact import Database
    from starcat.frames.planning.plan import Plan
    from starcat.geometry.camera import Camera
    from starcat.matcher.database import Database as MatcherDatabase
    from starcat.pipeline.simulation.simulate import SimulatedFrame
    from starcat.ship.exchange.export import Exported
    from starcat.ship.exchange.onboard import ExportedImage
    from starcat.ship.exchange.solvers.write import ExportedSolver
    from starcat.ship.releases.publishing import Published
    from starcat.ship.releases.pulling import Pulled


OPTIONS_OF_EXPORT = (
    "products", "max_partition_rows", "profile", "method", "endian", "max_bytes", "patch_from",
    "sign", "camera", "replace",
)  # fmt: skip
"""All options of `export`; each format accepts some of them."""


def simulate(
    database: MatcherDatabase | Database | PathLike,
    count: int = 1,
    *,
    noise_px: float = 0.5,
    noise_mag: float = 0.2,
    drop_probability: float = 0.0,
    false_stars: int = 0,
    seed: int | Generator | None = 0,
) -> list[SimulatedFrame]:
    """Simulate frames with the stars of a database, at random attitudes within its region.

    Parameters
    ----------
    database : MatcherDatabase, Database, str or path-like
        The ``database`` of a matcher, a database opened by ``starcat.open``, or its folder.
    count : int, default 1
        Number of frames.
    noise_px, noise_mag : float
        Standard deviations of centroids, on each axis, and of magnitudes.
    drop_probability : float, default 0
        Probability that a star is missing.
    false_stars : int, default 0
        Centroids in each frame that are not stars.
    seed : int, numpy.random.Generator or None, default 0
        The same seed gives the same frames. The first frames do not depend on ``count``, and
        ``starcat simulate --seed`` writes the first of them. A generator continues where it is;
        None gives other frames each time.

    Returns
    -------
    list of SimulatedFrame
        Frames for `Matcher.identify`, with ``centroids_px`` of shape (N, 2) and ``mag`` of shape
        (N,). ``matrix`` (body from ICRS) and ``star_index`` are the true attitude and stars.

    Raises
    ------
    ConfigError, ProductError
        If a number is out of range, or the database cannot be read.
    """
    from numpy.random import Generator

    from starcat.matcher.database import as_database
    from starcat.matcher.options import SIMULATED, checked_option
    from starcat.pipeline.simulation.selftest import part_of_database
    from starcat.pipeline.simulation.simulate import Noise, simulate_sequence, sky_of_guide_stars

    known = as_database("database", database)
    given = {
        "noise_px": noise_px, "noise_mag": noise_mag, "drop_probability": drop_probability,
    }  # fmt: skip
    numbers = {name: float(checked_option(name, one, SIMULATED)) for name, one in given.items()}
    noise = Noise(
        numbers["noise_px"],
        numbers["drop_probability"],
        whole_number("false_stars", false_stars, 0),
        noise_mag=numbers["noise_mag"],
    )
    sky, frames = sky_of_guide_stars(known.directions, known.mag), whole_number("count", count, 0)
    if seed is not None and not isinstance(seed, Generator):
        seed = whole_number("seed", seed, 0)
    part = part_of_database(known.folder)
    return list(simulate_sequence(sky, known.camera, frames, noise, seed, part))


def plan(
    database: Database | PathLike,
    attitudes: Any,
    *,
    orbit: Any = None,
    alignment: ArrayLike | None = None,
    camera: Camera | None = None,
    plot: PathLike | None = None,
    **expected: Any,
) -> Plan:
    """Plan the stars and errors of a star sensor at many attitudes, like ``starcat plan``.

    Parameters
    ----------
    database : Database, str or path-like
        The result of `starcat.open`, or the folder of a database.
    attitudes : path, table or array_like of float64, shape (K, 4)
        A CSV file, a CCSDS AEM (KVN), or a table (mapping, astropy, pandas, Arrow) with ``time``
        (UTC) and either ``q_body_from_icrs``, or ``qx`` to ``qw``, or ``ra_deg``, ``dec_deg`` and
        ``roll_deg``; or quaternions alone, scalar last.
    orbit : path or table, optional
        ``time``, ``x_km`` to ``z_km`` and ``vx_km_s`` to ``vz_km_s`` from the Earth in ICRS axes,
        or a CCSDS OEM (KVN). Without it the limb of the Earth, and aberration by the motion
        around the Earth, are left out.
    alignment : array_like of float64, shape (4,), optional
        Quaternion from the frame of the attitudes to the camera frame; by default they are equal.
    camera : Camera, optional
        By default the database's camera.
    plot : str or path-like, optional
        PNG or SVG file to write, with the plan over time.
    **expected
        ``noise_px`` and ``noise_mag`` (by default the values of the spec's self-test),
        ``limit_mag``, ``drop_probability``, ``false_stars``, ``window_arcsec`` (20 px),
        ``lookalike_mag`` (1), ``keep_out_deg`` (mapping of the body to degrees),
        ``min_acquisition`` (0.9) and ``max_false_match_probability``: the fields of
        `starcat.frames.planning.plan.Expected`.

    Returns
    -------
    Plan
        Errors, probabilities of acquisition, stars, bodies and gaps; `Plan.to_dict`, `Plan.best`.

    Raises
    ------
    ConfigError, ProductError
        In the same cases as ``starcat plan``.
    """
    from starcat.frames.planning.drawing import draw_plan
    from starcat.frames.planning.options import PLANNED
    from starcat.frames.planning.plan import plan_attitudes
    from starcat.storage.figures import check_kind

    drawing = None if plot is None else path_of("plot", plot)
    check_kind(drawing)
    folder = database_path("database", database)
    given = {"orbit": orbit, "alignment": alignment, "camera": camera}
    names = ("keep_out_deg", *PLANNED)
    unknown = sorted(set(expected) - set(names))
    if unknown:
        raise TypeError(f"plan has no argument {unknown[0]!r}; expected one of {', '.join(names)}")
    made = plan_attitudes(folder, attitudes, **given, **expected)
    if drawing is not None:
        draw_plan(made, drawing)
    return made


def export(
    database: Database | PathLike, form: str, output: PathLike | None = None, **options: Any
) -> Exported | ExportedImage | ExportedSolver:
    """Write tables of a database, its image for flight software, or another solver's database.

    Parameters
    ----------
    database : Database, str or path-like
        The result of `starcat.open`, or the folder of a database.
    form : str
        A format of ``starcat export --to``: csv, fits, votable, ... onboard, c, or a solver.
    output : str or path-like, optional
        Folder for tables (default ``export``) or for a solver's files; file name for an image.
    **options
        ``products``, ``replace``, ``max_partition_rows`` for tables; ``profile`` (full or small),
        ``method``, ``endian``, ``max_bytes``, ``patch_from``, ``replace``, ``sign`` (files of
        keys), ``camera`` (a file) for an image; ``replace`` for a solver.

    Returns
    -------
    Exported, ExportedImage or ExportedSolver
        The files that were written.

    Raises
    ------
    ConfigError, ProductError, OutputError, OnboardSizeError
        In the same cases as ``starcat export``.
    """
    from starcat.ship.exchange.export import export_tables, tables_of
    from starcat.ship.exchange.formats import ONBOARD_FORMATS, SOLVER_FORMATS
    from starcat.ship.exchange.onboard import export_image
    from starcat.ship.exchange.solvers.write import export_solver

    folder = database_path("database", database)
    target = None if output is None else path_of("output", output)
    run: Callable[..., Exported | ExportedImage | ExportedSolver]
    if form in ONBOARD_FORMATS:
        run = partial(export_image, folder, form, target)
    elif form in SOLVER_FORMATS:
        run = partial(export_solver, folder, form, target)
    else:
        run = partial(export_tables, tables_of(folder), form, target or Path("export"))
    unknown = sorted(set(options) - set(signature(run).parameters))
    if unknown:
        known = ", ".join(name for name in OPTIONS_OF_EXPORT if name in signature(run).parameters)
        text = f"export to {form!r} has no option {unknown[0]!r}; its options are {known}"
        raise TypeError(text)
    for name in ("max_partition_rows", "max_bytes"):
        if options.get(name) is not None:
            options[name] = whole_number(name, options[name], 1)
    if "sign" in options:
        options["sign"] = paths_of("sign", options["sign"])
    if options.get("products") is not None:
        products = options["products"]
        check_type("products", products, Iterable, "a sequence of names")
        options["products"] = [products] if isinstance(products, str) else list(products)
    return run(**options)


def publish(
    database: Database | PathLike,
    registry: PathLike,
    *,
    sign: PathLike | Sequence[PathLike] = (),
    threshold: int | None = None,
) -> Published:
    """Check a database and put it into a registry (a folder), where it will never change.

    Parameters
    ----------
    database : Database, str or path-like
        The result of `starcat.open`, or the folder of a database.
    registry : str or path-like
        A folder; made if it does not exist.
    sign : path or sequence of paths, default none
        Files of private keys to sign with, made by ``starcat keys new``.
    threshold : int, optional
        Number of signatures required from now on; only for a registry without signatures.

    Returns
    -------
    Published
        The release, and whether it is new in the registry.

    Raises
    ------
    ProductError
        If the database is damaged.
        Also if the registry has the version with other content.
    ConfigError
        If the registry is not a folder, or a key is not one of the registry's.
    OutputError
        If the registry cannot be written.
    """
    from starcat.ship.releases.metadata import read_signing
    from starcat.ship.releases.publishing import publish_artifact

    signing = read_signing(paths_of("sign", sign), threshold)
    place = text_of_path("registry", registry)
    return publish_artifact(database_path("database", database), place, signing=signing)


def pull(
    wanted: str, registry: PathLike, output: PathLike = "dist", *, trust: PathLike | None = None
) -> Pulled:
    """Get a published database and check every file of it.

    Parameters
    ----------
    wanted : str
        ``NAME@VERSION``, ``NAME@latest`` or ``NAME``.
    registry : str or path-like
        A folder, or an http(s) address.
    output : str or path-like, default "dist"
        Folder in which the folder ``<name>-<version>`` is made. ``starcat.lock`` in it pins the
        version.
    trust : str or path-like, optional
        A public key, or a root.json, that must have signed it; later pulls check it again.

    Returns
    -------
    Pulled
        ``folder`` is the folder of the database.

    Raises
    ------
    ConfigError, ProductError, SourceError, OutputError
        In the same cases as ``starcat pull``.
    """
    from starcat.ship.releases.lockfile import pull_wanted

    place = path_of("output", output)
    key = None if trust is None else path_of("trust", trust)
    chosen, source = text_of_path("wanted", wanted), text_of_path("registry", registry)
    return pull_wanted(chosen, source, place, place / "starcat.lock", trust=key)
