"""Plug-ins of starcat: the modules of a folder, sorted by the position that each states."""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache
from types import ModuleType


@cache
def plugin_modules(package: str) -> tuple[ModuleType, ...]:
    """Import the modules of a package that define ``POSITION``, and return them sorted by it.

    So a new product or selection rule is one new file, and no list has to name it. ``POSITION`` is
    a number. The order of products determines the bytes of a manifest, and the order of rules
    determines which reason a rejected star gets. Modules without ``POSITION`` are not plug-ins.

    Raises
    ------
    ValueError
        If two modules have the same ``POSITION``.
    """
    folder = importlib.import_module(package)
    names = [each.name for each in pkgutil.iter_modules(folder.__path__, f"{package}.")]
    modules = [importlib.import_module(name) for name in names]
    by_position: dict[float, ModuleType] = {}
    for module in modules:
        if (position := getattr(module, "POSITION", None)) is None:
            continue
        if position in by_position:
            raise ValueError(
                f"{module.__name__} and {by_position[position].__name__} both have POSITION = "
                f"{position}; give the new one a number between those of its neighbours"
            )
        by_position[position] = module
    return tuple(by_position[position] for position in sorted(by_position))
