"""Files of a source that are given twice: by the archive's name, or by what is in them.

Every star of such a file would be read twice, and rejected as a duplicate of itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from starcat.catalog.file_parts import FileFacts
from starcat.catalog.readers.files import InputFile, named_layout
from starcat.catalog.source import DataSource
from starcat.errors import SourceError


def check_names(files: Sequence[InputFile], source: DataSource) -> None:
    """Check that no file of the archive is given twice."""
    seen: dict[str, Path] = {}
    for file in files:
        name = file.path.name.removesuffix(".gz")
        earlier = seen.setdefault(name, file.path)
        # Files may have any names; only those of the archive say what is in them.
        if earlier is not file.path and named_layout(source, file.path):
            raise _twice(source, f"{name} is there twice", earlier, file.path)


def check_contents(
    files: Sequence[InputFile], facts: Sequence[FileFacts], source: DataSource
) -> None:
    """Check that no two files have the same content."""
    seen: dict[str, Path] = {}
    for file, fact in zip(files, facts, strict=True):
        earlier = seen.setdefault(fact.sha256, file.path)
        if earlier is not file.path:
            what = f"two files have the same content (sha256 {fact.sha256[:12]}…)"
            raise _twice(source, what, earlier, file.path)


def _twice(source: DataSource, what: str, one: Path, other: Path) -> SourceError:
    return SourceError(
        f"{source.name}: {what}: {one} and {other}; expected each part of the archive once. Leave "
        "one of them out, or fetch the part that should be there instead",
        source=source.name,
        path=other,
    )
