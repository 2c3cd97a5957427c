"""Fixtures that several test modules share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def catalogs() -> Path:
    """The folder of catalog excerpts, which are not part of the repository."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "catalogs"
    folder = Path(os.environ.get("STARCAT_CATALOGS") or beside)
    if not folder.is_dir():
        pytest.skip(
            "the folder of catalog excerpts is absent: set STARCAT_CATALOGS to it, "
            f"or put it at {beside}"
        )
    return folder
