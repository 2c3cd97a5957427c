"""The C compiler that tests of C code use."""

from __future__ import annotations

import shutil

import pytest


def c_compiler() -> str:
    """Return a C compiler; skip the test if none is installed."""
    found = shutil.which("gcc") or shutil.which("cc")
    if found is None:
        pytest.skip("there is no C compiler")
    return found
