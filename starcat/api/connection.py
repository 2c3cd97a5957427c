"""Tables to ask in SQL from Python."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

from starcat.resources import PathLike

if TYPE_CHECKING:  # a program that only matches has none of the libraries behind these
    from starcat.query.answer import Answer
    from starcat.query.session import Limits


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

    def sql(self, text: str, **values: Any) -> Answer:
        """Ask a query.

        Parameters
        ----------
        text : str
            SQL, one statement that reads.
        **values
            Values of the ``$name`` in it.

        Returns
        -------
        Answer
            All rows.

        Raises
        ------
        QueryError
            If the text is no query that may run.
        QueryLimitError
            If it takes more time or memory than it may.
        """
        from starcat.query.answer import Answer

        with self._session.ask(text, values) as answer:
            return Answer(answer.batches().read_all())

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
