"""What a session and the process that runs its queries say to each other.

A request is the name of a method of `starcat.query.worker.Worker` and its arguments; the replies
are pairs of a kind and what it brings. Both are pickled: each end is a process of this starcat.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

PROGRESS = "progress"
"""A percentage; more replies follow."""

PART = "part"
"""A part of the answer; more replies follow."""

DONE = "done"
"""The answer, or the last part of it."""

REFUSED = "refused"
"""Words: the query cannot be answered."""

SHORT = "short"
"""Words: memory or disk ran out."""

BROKEN = "broken"
"""Words: DuckDB failed, and should answer nothing more."""

ENDINGS = {DONE, REFUSED, SHORT, BROKEN}


@dataclass(frozen=True)
class Opening:
    """What a process is told before it starts DuckDB.

    Attributes
    ----------
    spill : Path
        Folder for what does not fit into the memory; the only one it may write in.
    memory_gb, disk_gb : float
        Gigabytes that DuckDB may take of each.
    parent : int
        Number of the process that asks; the worker ends when that one does.
    """

    spill: Path
    memory_gb: float
    disk_gb: float
    parent: int


@dataclass(frozen=True)
class Views:
    """What a process sees once it is locked.

    Attributes
    ----------
    sql : str
        Makes the views and macros.
    files : tuple of str
        The only files that it may read, with their full paths.
    macros : frozenset of str
        Names of the macros that stand after FROM.
    """

    sql: str
    files: tuple[str, ...]
    macros: frozenset[str]


@dataclass(frozen=True)
class Statement:
    """A query that may run.

    Attributes
    ----------
    text : str
        SQL that DuckDB wrote from the syntax tree that was checked, with EXPLAIN before it where
        that was asked for. Nothing else of the text that was given runs.
    is_description : bool
        Whether it is a DESCRIBE, whose rows are columns.
    view : tuple of str, optional
        Schema and name of the view that a DESCRIBE is about; the schema is empty where it has none.
    parameters : tuple of str
        Names of the ``$name`` in it.
    """

    text: str
    is_description: bool = False
    view: tuple[str, str] | None = None
    parameters: tuple[str, ...] = ()
