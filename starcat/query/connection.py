"""An open database for programs, and SQL over databases and catalogs."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from functools import cached_property
from typing import TYPE_CHECKING, Any

from starcat.arguments import database_path, without_unit
from starcat.database import reader
from starcat.database.manifest import read_manifest
from starcat.database.onboard.reading import is_image
from starcat.errors import ConfigError, DatabaseMissing, QueryError, literal, python_name
from starcat.html_tables import html_table
from starcat.resources import PathLike

if TYPE_CHECKING:  # an installation that only matches lacks the libraries these import
    from starcat.database.verify import Verification
    from starcat.matcher.matcher import Matcher
    from starcat.pipeline.report.report import CoverageReport
    from starcat.pipeline.specs.build_spec import BuildSpec
    from starcat.query.result import QueryResult
    from starcat.query.session import Limits, Session


class Database(reader.DatabaseFolder):
    """A guide-star database on disk, opened by `open_for_query` (``starcat.open``).

    Attributes
    ----------
    folder : Path
        The folder of the database.
    manifest : dict
        What ``manifest.json`` states: spec, sources, products and digests.
    """

    @cached_property
    def spec(self) -> BuildSpec:
        """The spec that the database was built from."""
        from starcat.pipeline.specs.reading import spec_of_database

        return spec_of_database(self)

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
        from starcat.matcher.matcher import Matcher

        return Matcher.open(self.folder, method, **limits)

    def sql(self, text: str, **values: Any) -> QueryResult:
        """Run a query over the products.

        Parameters
        ----------
        text : str
            SQL, one statement that only reads. Every product is a table; ``starcat sql --macros``
            lists the macros.
        **values
            Values of the parameters ``$name`` in the text. A quantity is converted to the unit at
            the end of the name, as in ``$limit_mag``.

        Returns
        -------
        QueryResult
            All rows.

        Raises
        ------
        QueryError
            If the text is not a query, or the query is not allowed.
        ConfigError
            If a quantity cannot be converted to the unit at the end of its parameter's name.
        """
        with connect(self.folder) as connection:
            return connection.sql(text, **values)

    def coverage(self) -> CoverageReport:
        """Return how many stars, pairs and triangles the fields contain, as in the report.

        Returns
        -------
        CoverageReport
            ``summary`` has the smallest, the median and the largest numbers.
        """
        from starcat.pipeline.report_data import database_coverage

        return database_coverage(self)

    def verify(self) -> Verification:
        """Check every file, order, index and reference, like `starcat.verify`.

        Returns
        -------
        Verification
            Its ``findings`` are empty for a sound database.
        """
        from starcat.database.verify import verify

        return verify(self)

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
    if is_image(path):
        raise DatabaseMissing(
            f"{path} is an onboard image, which holds no tables",
            path=path,
            hint="read it with starcat.Matcher.open, or open the folder of the database that it "
            "was made from",
        )
    return Database(path, read_manifest(path))


class Connection:
    """Tables for SQL queries, opened by `connect`; a context manager.

    Parameters
    ----------
    targets : sequence of str
        Databases, tables and catalogs, as `connect` takes them.
    limits : Limits, optional
        Limits of each query.
    """

    def __init__(self, targets: Sequence[str], limits: Limits | None = None) -> None:
        from starcat.query.session import open_session

        self._targets = targets
        self._open = ExitStack()
        self._session: Session | None = self._open.enter_context(open_session(targets, limits))

    def sql(self, text: str, **values: Any) -> QueryResult:
        """Run a query, like `Database.sql`.

        Parameters
        ----------
        text : str
            SQL, one statement that only reads.
        **values
            Values of the parameters ``$name`` in the text.

        Returns
        -------
        QueryResult
            All rows.

        Raises
        ------
        QueryError
            If the text is not a query, the query is not allowed, or the connection is closed.
        QueryLimitError
            If the query exceeds a limit.
        """
        from starcat.query.result import QueryResult

        if self._session is None:
            raise QueryError("the connection is closed", hint="open it again with starcat.connect")
        arguments = {name: _value_of_query(name, value) for name, value in values.items()}
        try:
            with self._session.ask(text, arguments) as answer:
                return QueryResult(answer.batches().read_all())
        except QueryError as error:
            error.hint = literal(error.advice_for(_argument_of))
            raise

    def close(self) -> None:
        """Close the tables, and remove the temporary files made for reading them."""
        self._session = None
        self._open.close()

    def __enter__(self) -> Connection:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<Connection to {', '.join(self._targets)}>"


def _value_of_query(name: str, value: Any) -> Any:
    """Return a value of a query without its unit, and a number of numpy as one of Python.

    A quantity is converted to the unit of its parameter.
    """
    try:
        plain = without_unit(name, value)
        return plain.item() if hasattr(plain, "item") and getattr(plain, "ndim", 1) == 0 else plain
    except ConfigError as error:
        error.hint = "The name of a value of a query may end with its unit, as in $limit_mag"
        raise


_LIMITS = {"time_limit_s": "Limits.time_s", "memory_limit_gb": "Limits.memory_gb"}


def _argument_of(parameter: str, value: str, item: str) -> str:
    """Return what a parameter of a query is called here."""
    return f"{item}=..." if item else _LIMITS.get(parameter, python_name(parameter, value))


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
