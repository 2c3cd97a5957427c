"""What ``import starcat`` gives: databases, catalogs and queries in a few names.

Each function here turns strings into paths, fills in what is usual, and calls the one function
of the rooms that the command line calls too.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starcat.artifact.manifest import read_manifest

if TYPE_CHECKING:  # a program that only matches has none of the libraries behind these
    import pyarrow as pa

    from starcat.artifact.verify import Verification
    from starcat.catalog.ingest import Ingested
    from starcat.matcher.matcher import Matcher
    from starcat.pipeline.build import Built
    from starcat.progress import Progress
    from starcat.query.answer_table import AnswerTable
    from starcat.query.session import Limits
    from starcat.report.coverage_report import CoverageReport
    from starcat.specs.build_spec import BuildSpec

PathLike = str | os.PathLike[str]


class Products(Mapping[str, "pa.Table"]):
    """The tables of an artifact by name; each is read when it is asked for.

    Parameters
    ----------
    folder : Path
        Of the artifact.
    manifest : dict
        Of the artifact.
    """

    def __init__(self, folder: Path, manifest: dict[str, Any]) -> None:
        self._folder = folder
        self._manifest = manifest

    def __getitem__(self, name: str) -> pa.Table:
        """Return a product as an Arrow table; `KeyError` if there is none of that name."""
        from starcat.artifact.reader import Artifact as Reader

        if name not in self._manifest["products"]:
            raise KeyError(name)
        return Reader(self._folder, self._manifest).table(name)

    def __iter__(self) -> Iterator[str]:
        """Go through the names, in the order of the manifest."""
        return iter(self._manifest["products"])

    def __len__(self) -> int:
        """Return the number of products."""
        return len(self._manifest["products"])

    def __repr__(self) -> str:
        """Return the names and rows in one line."""
        counts = [(name, one["rows"]) for name, one in self._manifest["products"].items()]
        return f"<Products: {', '.join(f'{name} ({rows:,})' for name, rows in counts)}>"


class Artifact:
    """A guide-star database on disk, opened by `open_artifact` (``starcat.open``).

    Parameters
    ----------
    folder : Path
        The folder ``<name>-<version>``.
    manifest : dict
        What it is made of: spec, sources, products, digests.
    """

    def __init__(self, folder: Path, manifest: dict[str, Any]) -> None:
        self.folder = folder
        self.manifest = manifest

    @property
    def products(self) -> Products:
        """The tables by name: ``artifact.products["pairs"]``."""
        return Products(self.folder, self.manifest)

    @cached_property
    def stars(self) -> pa.Table:
        """The guide stars as an Arrow table, by star number."""
        return self.products["stars"]

    @cached_property
    def spec(self) -> BuildSpec:
        """The spec that the artifact was built from."""
        from starcat.specs.reading import spec_from_dict

        return spec_from_dict(self.manifest["spec"], "manifest.json")

    def matcher(self, method: str | None = None, **limits: Any) -> Matcher:
        """Open the database for identifying stars.

        Parameters
        ----------
        method : str, optional
            As ``starcat methods`` lists them; the best that the products allow by default.
        **limits
            ``tolerance_px`` and the others of `Matcher.open`.

        Returns
        -------
        Matcher
            Ready to identify. Needs numpy and h5py only.
        """
        from starcat.matcher.matcher import Matcher

        return Matcher.open(self.folder, method, **limits)

    def sql(self, text: str, **values: Any) -> AnswerTable:
        """Ask a query about the products.

        Parameters
        ----------
        text : str
            SQL, one statement that reads; every product is a table, the macros of
            ``docs/sql.md`` are there.
        **values
            Of the ``$name`` in it.

        Returns
        -------
        AnswerTable
            All rows.

        Raises
        ------
        QueryError
            If the text is no query that may run.
        """
        with connect(self.folder) as connection:
            return connection.sql(text, **values)

    def coverage(self) -> CoverageReport:
        """Return how many stars, pairs and triangles the fields hold.

        Returns
        -------
        CoverageReport
            As the report of the build has it.
        """
        from starcat.artifact.reader import Artifact as Reader
        from starcat.pipeline.facts import artifact_coverage

        return artifact_coverage(Reader(self.folder, self.manifest))

    def verify(self) -> Verification:
        """Check every file, order, index and reference.

        Returns
        -------
        Verification
            With its findings; none where all is well.
        """
        return verify(self.folder)

    def __repr__(self) -> str:
        """Return name, stars and field in one line."""
        stars = self.manifest["products"]["stars"]["rows"]
        name = f"{self.manifest['name']}-{self.manifest['version']}"
        epoch, count = self.manifest["epoch_jyear"], len(self.products)
        return f"<Artifact {name}: {stars:,} guide stars at J{epoch:g}, {count} products>"

    def _repr_html_(self) -> str:
        """Return the products as a table for a notebook."""
        from html import escape

        rows = "".join(
            f"<tr><td>{escape(name)}</td><td>{facts['rows']:,}</td></tr>"
            for name, facts in self.manifest["products"].items()
        )
        head = "<thead><tr><th>product</th><th>rows</th></tr></thead>"
        return f"<p>{escape(repr(self)[1:-1])}</p><table>{head}<tbody>{rows}</tbody></table>"


class Connection:
    """Tables to ask in SQL, opened by `connect`; a context manager.

    Parameters
    ----------
    targets : sequence of str
        As for ``starcat sql``.
    limits : Limits, optional
        Time and memory of a query.
    """

    def __init__(self, targets: Sequence[str], limits: Limits | None = None) -> None:
        from starcat.query.session import open_session

        self._targets = targets
        self._open = ExitStack()
        self._session = self._open.enter_context(open_session(targets, limits))

    def sql(self, text: str, **values: Any) -> AnswerTable:
        """Ask a query.

        Parameters
        ----------
        text : str
            SQL, one statement that reads.
        **values
            Of the ``$name`` in it.

        Returns
        -------
        AnswerTable
            All rows.

        Raises
        ------
        QueryError
            If the text is no query that may run.
        QueryLimitError
            If it takes more time or memory than it may.
        """
        from starcat.query.answer_table import AnswerTable

        with self._session.ask(text, values) as answer:
            return AnswerTable(answer.batches().read_all())

    def close(self) -> None:
        """Forget the tables, and what was made to read them."""
        self._open.close()

    def __enter__(self) -> Connection:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close it."""
        self.close()

    def __repr__(self) -> str:
        """Return the targets in one line."""
        return f"<Connection to {', '.join(self._targets)}>"


def open_artifact(folder: PathLike) -> Artifact:
    """Open a guide-star database.

    Parameters
    ----------
    folder : str or path-like
        The folder ``<name>-<version>`` that a build or a pull made.

    Returns
    -------
    Artifact
        With its manifest read; all else is read when it is asked for.

    Raises
    ------
    ProductError
        If the folder is not an artifact.
    SchemaVersionError
        If another version of starcat wrote it.
    """
    path = Path(folder)
    return Artifact(path, read_manifest(path))


def build(
    spec: BuildSpec | PathLike,
    output: PathLike = "dist",
    *,
    inputs: Mapping[str, PathLike | Sequence[PathLike]] | None = None,
    replace: bool = False,
    workers: int = 2,
    progress: Progress | None = None,
) -> Built:
    """Build a guide-star database, check it, and prove that it identifies its own fields.

    Parameters
    ----------
    spec : BuildSpec, str or path-like
        A spec, or the TOML file of one.
    output : str or path-like, default "dist"
        Folder that the folder ``<name>-<version>`` is made in.
    inputs : mapping of str to path or paths, optional
        Files or folders by source; what is not named is looked for, as the command line does.
    replace : bool, default False
        Whether a different artifact of the same name and version may be replaced.
    workers : int, default 2
        Threads; the artifact is the same for any number.
    progress : callable, optional
        Called with (stage, done, total).

    Returns
    -------
    Built
        The folder and what is worth telling about it.

    Raises
    ------
    ConfigError, SourceError, BuildError, OutputError
        As the command line says them.
    """
    from starcat.pipeline.build import build as run
    from starcat.progress import no_progress
    from starcat.specs.build_spec import BuildSpec
    from starcat.specs.reading import read_spec

    chosen = spec if isinstance(spec, BuildSpec) else read_spec(spec)
    given = {source: _paths(files) for source, files in (inputs or {}).items()}
    return run(
        chosen,
        given,
        Path(output),
        replace=replace,
        workers=workers,
        progress=progress or no_progress,
    )


def ingest(
    source: str,
    inputs: PathLike | Sequence[PathLike] | None = None,
    *,
    band: str | None = None,
    epoch_jyear: float | None = None,
    read_limit_mag: float | None = None,
    progress: Progress | None = None,
) -> Ingested:
    """Read a catalog into a star table, with a reason for every record left out.

    Parameters
    ----------
    source : str
        Such as ``sao``; ``starcat sources`` lists them.
    inputs : path or sequence of paths, optional
        Its files or folder; looked for by default, as the command line does.
    band : str, optional
        Band of the magnitudes; the source's first by default.
    epoch_jyear : float, optional
        Julian year to move positions to; the catalog's own by default.
    read_limit_mag : float, optional
        Fainter records are rejected.
    progress : callable, optional
        Called with (stage, done, total).

    Returns
    -------
    Ingested
        Star table, rejected rows and what was read.

    Raises
    ------
    ConfigError, SourceError
        If the source is unknown, or its files are missing or damaged.
    """
    from starcat.catalog.fetching.locate import locate
    from starcat.catalog.ingest import ingest as read
    from starcat.progress import no_progress

    return read(
        source,
        locate(source, {source: _paths(inputs)} if inputs is not None else {}),
        band=band,
        epoch_jyear=epoch_jyear,
        read_limit_mag=read_limit_mag,
        progress=progress or no_progress,
    )


def verify(artifact: PathLike) -> Verification:
    """Check an artifact: digests, schemas, rows, orders, indices, references, counts.

    Parameters
    ----------
    artifact : str or path-like
        The folder ``<name>-<version>``.

    Returns
    -------
    Verification
        With its findings; none where all is well.

    Raises
    ------
    ProductError
        If the folder is not an artifact.
    """
    from starcat.artifact.verify import verify_artifact

    return verify_artifact(Path(artifact))


def connect(*targets: PathLike, limits: Limits | None = None) -> Connection:
    """Open artifacts, star tables and catalogs for questions in SQL.

    Parameters
    ----------
    *targets : str or path-like
        Folders of artifacts, Parquet files, archive files, or names of sources.
    limits : Limits, optional
        Time, memory and disk of a query.

    Returns
    -------
    Connection
        To be closed, or used in a ``with`` statement.

    Raises
    ------
    QueryError, ProductError, SourceError
        If a target cannot be read.
    """
    return Connection([os.fspath(target) for target in targets], limits)


def _paths(given: PathLike | Sequence[PathLike]) -> list[Path]:
    one = isinstance(given, str | os.PathLike)
    return [Path(given)] if one else [Path(path) for path in given]  # type: ignore[arg-type, union-attr]
