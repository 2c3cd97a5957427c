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
    from starcat.api.artifact import Database
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
