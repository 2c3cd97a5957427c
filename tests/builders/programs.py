"""Programs that run in a Python of their own."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ONLY_NUMPY_AND_H5PY = """
import importlib, sys
class Nothing:
    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        if top not in sys.stdlib_module_names and top not in ("numpy", "h5py", "starcat"):
            raise ImportError(name)
sys.meta_path.insert(0, Nothing())
"""
"""A program's beginning that makes all else impossible to import than the matcher needs."""


def printed_by(*arguments: object, cwd: Path | None = None) -> str:
    """Run Python with some arguments, which must end well, and return what it prints."""
    command = [sys.executable, *map(str, arguments)]
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout
