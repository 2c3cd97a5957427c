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
    """Return malformed records as rows of the rejected table."""
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
    """Return the error for a file in whose first block no record is good."""
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
    file: InputFile, rows: int, malformed: int, problems: Sequence[Problem], source: DataSource
) -> None:
    """Refuse a file without records or with too many malformed ones."""
    if not rows:
        raise ParseError(
            f"{file.path}: no record in the file; expected records of {source.name} "
            f"({file.layout.name}). Is this the right archive?",
            source=source.name,
            path=file.path,
        )
    if malformed > 10 and malformed > MAX_MALFORMED_FRACTION * rows:
        raise ParseError(
            f"{file.path}: {malformed} of {rows} records are malformed; at most "
            f"{MAX_MALFORMED_FRACTION:.0%} may be. The first: {problems[0]}",
            source=source.name,
            path=file.path,
            line=problems[0].line,
            byte_range=problems[0].byte_range,
            field=problems[0].field,
        )
