"""Records that do not follow the layout: as rows of the rejected table, or as an error."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pyarrow as pa

from starcat.catalog.readers.files import InputFile
from starcat.catalog.readers.records import Problem
from starcat.catalog.source import DataSource
from starcat.catalog.stars import table_from_columns
from starcat.catalog.verdict import Reason
from starcat.errors import ParseError

MAX_MALFORMED_FRACTION = 0.01
"""Above this share of malformed records (and more than 10 of them) a file is refused."""


def malformed_rows(
    problems: Sequence[Problem], number: int, source_name: str, band: str
) -> pa.Table:
    """Return malformed records as rows of the rejected table.

    Parameters
    ----------
    problems : sequence of Problem
        The problems of one file.
    number : int
        The file's number.
    source_name, band : str
        What it was read as.

    Returns
    -------
    pyarrow.Table
        Table of the rejected schema; only place, reason and detail are known.
    """
    return table_from_columns(
        "rejected",
        {
            "catalog": source_name,
            "band": band,
            "source_file": number,
            "source_line": np.array([problem.line for problem in problems]),
            "reason": Reason.malformed_record.name,
            "detail": pa.array([str(problem) for problem in problems]),
        },
        len(problems),
    )


def not_this_archive(
    file: InputFile, source: DataSource, problems: Sequence[Problem]
) -> ParseError:
    """Return the error for a file in whose first block no record is good.

    Parameters
    ----------
    file : InputFile
        The file.
    source : DataSource
        What it was taken for.
    problems : sequence of Problem
        The problems of its first records.

    Returns
    -------
    ParseError
        To be raised.
    """
    first = problems[0]
    return ParseError(
        f"{file.path}: none of the first {len(problems)} records is one of {source.name} "
        f"({file.layout.name}): {first}. Is this the right archive?",
        source=source.name,
        path=file.path,
        line=first.line,
        byte_range=first.byte_range,
        field=first.field,
    )


def check_malformed(
    files: Sequence[InputFile],
    rows: Sequence[int],
    problems: Sequence[tuple[int, Problem]],
    source: DataSource,
) -> None:
    """Refuse a file without records or with too many malformed ones.

    Parameters
    ----------
    files : sequence of InputFile
        What was read.
    rows : sequence of int
        Records in each.
    problems : sequence of (int, Problem)
        File number and problem of every malformed record.
    source : DataSource
        What they belong to.

    Raises
    ------
    ParseError
        If a file has no record, or more than 10 of them and 1 % are malformed.
    """
    for number, file in enumerate(files):
        if not rows[number]:
            raise ParseError(
                f"{file.path}: no record in the file; expected records of {source.name} "
                f"({file.layout.name}). Is this the right archive?",
                source=source.name,
                path=file.path,
            )
        bad = [problem for n, problem in problems if n == number]
        if len(bad) > 10 and len(bad) > MAX_MALFORMED_FRACTION * rows[number]:
            raise ParseError(
                f"{file.path}: {len(bad)} of {rows[number]} records are malformed; at most "
                f"{MAX_MALFORMED_FRACTION:.0%} may be. The first: {bad[0]}",
                source=source.name,
                path=file.path,
                line=bad[0].line,
                byte_range=bad[0].byte_range,
                field=bad[0].field,
            )
