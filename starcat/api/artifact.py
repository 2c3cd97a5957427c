"""An open database for programs, and SQL over databases and catalogs."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

from starcat.arguments import database_path
from starcat.artifact import reader
from starcat.artifact.manifest import read_manifest
from starcat.html_tables import html_table
from starcat.resources import PathLike

if TYPE_CHECKING:  # an installation that only matches lacks the libraries these import
    from starcat.api.matcher import Matcher
    from starcat.artifact.verify import Verification
    from starcat.query.result import QueryResult
    from starcat.query.session import Limits
    from starcat.report.report import CoverageReport


class Database(reader.DatabaseFolder):
    """A guide-star database on disk, opened by `open_for_query` (``starcat.open``).

    ``folder`` is its folder. ``manifest`` states spec, sources, products and digests.
    """

    def matcher(self, method: str | None = None, **limits: Any) -> Matcher:
        """Open the database for identifying stars.

        Parameters
        ----------
        method : str, optional
            One that ``starcat methods`` lists; by default the best that the products allow.
        **limits
            ``tolerance_px`` and other keyword arguments of `Matcher.open`.

        Returns
        -------
        Matcher
            Ready to identify. Needs numpy and h5py only.
        """
        from starcat.api.matcher import Matcher

        return Matcher.open(self.folder, method, **limits)

    def sql(self, text: str, **values: Any) -> QueryResult:
        """Run a query over the products.

        Parameters
        ----------
        text : str
            SQL, one statement that only reads. Every product is a table; ``docs/sql.md`` lists
            the macros.
        **values
            Values of the parameters ``$name`` in the text.

        Returns
        -------
        QueryResult
            All rows.

        Raises
        ------
        QueryError
            If the text is not a query, or the query is not allowed.
        """
        with connect(self.folder) as connection:
            return connection.sql(text, **values)

    def coverage(self) -> CoverageReport:
        """Return how many stars, pairs and triangles the fields contain, as in the report."""
        from starcat.pipeline.report_data import artifact_coverage

        return artifact_coverage(self)

    def verify(self) -> Verification:
        """Check every file, order, index and reference, like `starcat.verify`."""
        from starcat.artifact.verify import verify_artifact

        return verify_artifact(self.folder)

    def _repr_html_(self) -> str:
        """Return the products as a table for a notebook."""
        products = self.manifest["products"]
        rows = [(name, f"{facts['rows']:,}") for name, facts in products.items()]
        return html_table(("product", "rows"), rows, len(rows), repr(self)[1:-1])


def open_for_query(folder: PathLike) -> Database:
    """Open a guide-star database.

    Parameters
    ----------
    folder : str or path-like
        The folder ``<name>-<version>`` that a build or a pull made.

    Returns
    -------
    Database
        The manifest is read; everything else is read when it is used.

    Raises
    ------
    ProductError
        If the folder is not a database.
    SchemaVersionError
        If another version of starcat wrote it.
    """
    path = database_path("folder", folder)
    return Database(path, read_manifest(path))


class Connection:
    """Tables for SQL queries, opened by `connect`; a context manager."""

    def __init__(self, targets: Sequence[str], limits: Limits | None = None) -> None:
        from starcat.query.session import open_session

        self._targets = targets
        self._open = ExitStack()
        self._session = self._open.enter_context(open_session(targets, limits))

    def sql(self, text: str, **values: Any) -> QueryResult:
        """Run a query like `Database.sql`; QueryLimitError if it exceeds a limit."""
        from starcat.query.result import QueryResult

        with self._session.ask(text, values) as answer:
            return QueryResult(answer.batches().read_all())

    def close(self) -> None:
        """Close the tables, and remove the temporary files made for reading them."""
        self._open.close()

    def __enter__(self) -> Connection:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<Connection to {', '.join(self._targets)}>"


def connect(*targets: Database | PathLike, limits: Limits | None = None) -> Connection:
    """Open databases, star tables and catalogs for SQL queries.

    Parameters
    ----------
    *targets : Database, str or path-like
        Databases or their folders, Parquet files, archive files, or names of sources.
    limits : Limits, optional
        Limits of time, memory and disk for each query.

    Returns
    -------
    Connection
        Close it after use, or use it in a ``with`` statement.

    Raises
    ------
    QueryError, ProductError, SourceError
        If a target cannot be read.
    """
    return Connection([_target(target) for target in targets], limits)


def _target(target: Database | PathLike) -> str:
    """Return a target as text; the name of a source and an address are not paths."""
    return target if isinstance(target, str) else str(database_path("targets", target))
