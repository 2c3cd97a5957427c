"""The names that a room exports to packages; each is imported at its first use (PEP 562).

``__init__.pyi`` of the room lists them as imports. Type checkers read it, and so does `lazy_names`.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

_EXPORT = re.compile(r"^from (\S+) import (\w+) as (\w+)$", re.MULTILINE)


def exports_of(stub: Path) -> dict[str, tuple[str, str]]:
    """Return the module and name behind each exported name of a room; empty without the file."""
    text = stub.read_text(encoding="utf-8") if stub.is_file() else ""
    return {exported: (module, name) for module, name, exported in _EXPORT.findall(text)}


def lazy_names(room: str, file: str) -> Callable[[str], Any]:
    """Return the ``__getattr__`` of a room, of which ``file`` is the ``__init__.py``."""
    exports = cache(lambda: exports_of(Path(file).with_suffix(".pyi")))

    def load(name: str) -> Any:
        if name not in exports():
            raise AttributeError(f"module {room!r} has no attribute {name!r}")
        module, own = exports()[name]
        found = getattr(import_module(module), own)
        setattr(sys.modules[room], name, found)
        return found

    return load
