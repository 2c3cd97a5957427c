"""Layers: rooms import downwards only, and the matcher and the CLI start light."""

from __future__ import annotations

import ast
import graphlib
import importlib
import os
import re
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import ModuleType

import pytest
from programs import ONLY_NUMPY_AND_H5PY, printed_by

import starcat
from starcat.rooms import exports_of

PACKAGE = Path(starcat.__file__).parent
PACKAGES = {
    "starcat_lab": PACKAGE.parent / "packages" / "lab" / "starcat_lab",
    "starcat_service": PACKAGE.parent / "packages" / "service" / "starcat_service",
}
"""Packages beside starcat, in the order in which one can import another; they import starcat."""

HOUSE = Path(__file__).parents[2] / "docs" / "house.md"


HOUSE_TEXT = HOUSE.read_text(encoding="utf-8")

ROOMS = [
    name
    for name in re.findall(r"^\| `([\w.]+)` \|", HOUSE_TEXT, re.M)
    if name.partition(".")[0] != "starcat"
]
"""Names in the table of docs/house.md, in its order: parts, and rooms such as catalog.bands."""

ENTRY_POINTS = re.findall(r"^\| `(starcat(?:\.\w+)*)` \|", HOUSE_TEXT, re.M)
"""Names from which the packages beside starcat can import."""

SINGLE_MODULES = {
    "ground": [
        "arguments", "arrays", "errors", "failures", "html_tables", "local_files",
        "progress", "resources", "results", "rooms", "sections", "threads", "version",
    ],
    "cli": ["", "__main__", "client"],  # "" is starcat itself
}  # fmt: skip

GEOMETRY = ("attitude", "camera", "distortion", "kvector", "patterns", "sphere")
ONBOARD = ("flight_limits", "grid", "image", "layout", "reading")
LIGHT = {
    "starcat.arguments",
    "starcat.arrays",
    "starcat.errors",
    "starcat.html_tables",
    "starcat.resources",
    "starcat.results",
    "starcat.rooms",
    "starcat.version",
    "starcat.storage.atomic",
    "starcat.storage.cache",
    "starcat.storage.hdf5",
    "starcat.database.products.layouts",
    "starcat.storage.compressed",
    "starcat.storage.file_formats",
    "starcat.storage.regular_files",
    "starcat.storage.schema",
    *(f"starcat.geometry.{name}" for name in GEOMETRY),
    *(f"starcat.database.onboard.{name}" for name in ONBOARD),
}
"""What a small machine carries along with the matcher."""


def test_every_folder_of_tests_is_named_after_a_part_or_a_room():
    folders = {path.parent.name for path in HOUSE.parents[1].glob("tests/*/test_*.py")}
    words = {word for name in ROOMS for word in name.split(".")}
    assert folders - {"project", "extending"} <= words


def module_name(path: Path, package: Path) -> str:
    parts = path.relative_to(package.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {
    module_name(path, package): path
    for package in (PACKAGE, *PACKAGES.values())
    for path in sorted(package.rglob("*.py"))
}


def room_of(module: str) -> str:
    """Return the room of a module of starcat, or the package beside starcat."""
    if module.partition(".")[0] in PACKAGES:
        return module.partition(".")[0]
    _, *names = module.split(".")
    for room in (".".join(names[:2]), *names[:1]):
        if room in ROOMS and (PACKAGE / room.replace(".", "/")).is_dir():
            return room
    first = names[0] if names else ""
    return next((room for room, names in SINGLE_MODULES.items() if first in names), "no room")


def tree_of(module: str) -> ast.Module:
    return ast.parse(MODULES[module].read_text(encoding="utf-8"))


def statements(node: ast.AST) -> Iterator[ast.AST]:
    """Return the statements of a node, inner ones included; `ast.walk` also visits expressions."""
    for part in ("body", "orelse", "handlers", "finalbody", "cases"):
        for inner in getattr(node, part, ()):
            yield inner
            yield from statements(inner)


@cache
def import_statements(module: str) -> list[ast.Import | ast.ImportFrom]:
    """Return all of them: at the top, in functions and for type checkers alike.

    Trees are not kept: Python would search them for garbage again with each further tree.
    """
    found = statements(tree_of(module))
    return [node for node in found if isinstance(node, ast.Import | ast.ImportFrom)]


@cache
def imports_of(module: str) -> set[str]:
    """Return all names that a module imports."""
    found = set()
    for node in import_statements(module):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"line {node.lineno}: write imports in full, without dots"
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                found.add(full if full in MODULES else str(node.module))
    return found


def of_starcat(names: set[str]) -> set[str]:
    return {name for name in names if name.split(".")[0] in ("starcat", *PACKAGES)}


def outsiders(names: set[str]) -> set[str]:
    tops = {name.split(".")[0] for name in names}
    return tops - set(sys.stdlib_module_names) - {"starcat", *PACKAGES}


def loaded_by(code: str, depth: int = 1) -> set[str]:
    """Return the modules down to some depth that a fresh interpreter has loaded after some code."""
    names = f"{{'.'.join(name.split('.')[:{depth}]) for name in sys.modules}}"
    return set(printed_by("-c", f"{code}\nimport sys\nprint(*{names})").split())


def test_each_room_of_the_house_is_a_folder():
    assert len(ROOMS) == len(set(ROOMS))
    parts = {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    assert parts | {"ground"} == {name.partition(".")[0] for name in ROOMS}
    assert all((PACKAGE / name.replace(".", "/")).is_dir() for name in ROOMS if name != "ground")


def test_no_import_leads_upwards():
    places = [*ROOMS, *PACKAGES]
    homeless = [module for module in MODULES if room_of(module) not in places]
    assert not homeless, f"state in {HOUSE.name} to which room they belong"
    upward = {
        module: name
        for module in MODULES
        for name in of_starcat(imports_of(module))
        if places.index(room_of(name)) > places.index(room_of(module))
    }
    assert not upward, "imported from a later room"


OF_PACKAGES = [name for name in MODULES if name.partition(".")[0] in PACKAGES]


def test_packages_import_from_entry_points_only():
    inner = {
        module: name
        for module in OF_PACKAGES
        for name in imports_of(module) - set(ENTRY_POINTS)
        if name.split(".")[0] == "starcat"
    }
    assert not inner, f"{HOUSE.name} lists the entry points of packages"


def names_that_packages_import() -> dict[str, set[str]]:
    """Return by entry point the names that the packages import from it."""
    found: dict[str, set[str]] = {}
    for module in OF_PACKAGES:
        for node in import_statements(module):
            if isinstance(node, ast.ImportFrom):
                found.setdefault(str(node.module), set()).update(one.name for one in node.names)
            elif isinstance(node, ast.Import):
                for alias in node.names:
                    found.setdefault(alias.name, set())
    return found


def test_rooms_export_what_packages_import_and_nothing_else():
    imported = names_that_packages_import()
    assert len(ENTRY_POINTS) <= 31
    assert set(ENTRY_POINTS) <= set(imported)
    exported = {
        ".".join(stub.parent.relative_to(PACKAGE.parent).parts): set(exports_of(stub))
        for stub in PACKAGE.rglob("__init__.pyi")
    }
    rooms = [name for name in ENTRY_POINTS if name.removeprefix("starcat.") in ROOMS]
    assert exported == {room: imported[room] for room in rooms}


def test_a_room_gives_the_names_that_it_exports():
    for room in (name for name in ENTRY_POINTS if name.removeprefix("starcat.") in ROOMS):
        module = importlib.import_module(room)
        for name in exports_of(Path(str(module.__file__)).with_suffix(".pyi")):
            assert not isinstance(getattr(module, name), ModuleType), f"{room}.{name} is a module"
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = importlib.import_module("starcat.query").nothing


def test_no_imports_go_in_circles():
    # A package's own file runs first, but it is not something that its modules wait for.
    graph = {name: of_starcat(imports_of(name)) - {name} for name in MODULES}
    assert list(graphlib.TopologicalSorter(graph).static_order())


@pytest.mark.parametrize(
    "module", [name for name in MODULES if room_of(name) == "database.products"]
)
def test_products_know_neither_catalogs_nor_databases(module):
    rooms = {room_of(name) for name in of_starcat(imports_of(module))}
    assert rooms <= {"ground", "geometry", "storage", "catalog.stars", "database.products"}


OPTIONAL = {
    "starcat.matcher.batch": {"astropy"},
    "starcat.matcher.result": {"astropy", "matplotlib", "scipy"},
    "starcat.matcher.sky_objects": {"astropy", "matplotlib", "scipy"},
    "starcat.storage.schema": {"pyarrow"},
}
"""Modules that return objects of an optional library, which is imported on the first call."""


@pytest.mark.parametrize("module", [name for name in MODULES if room_of(name) == "matcher"])
def test_the_matcher_needs_little(module):
    names = imports_of(module)
    own = {name for name in of_starcat(names) if room_of(name) == "matcher"}
    assert of_starcat(names) - own <= LIGHT
    assert outsiders(names) <= {"numpy", "h5py", *OPTIONAL.get(module, ())}


@pytest.mark.parametrize("module", sorted(LIGHT))
def test_what_the_matcher_needs_needs_little(module):
    names = imports_of(module)
    assert of_starcat(names) <= LIGHT
    assert outsiders(names) <= {"numpy", *OPTIONAL.get(module, ())}


ROOM_BY_ROOM = """
import os, sys
import astropy.io.fits, astropy.io.votable, astropy.table, astropy.wcs, duckdb, fastapi, h5py
import lxml.etree, matplotlib.pyplot, PIL.Image, pyarrow.dataset, pyarrow.parquet, requests
import rich.table, scipy.ndimage, scipy.optimize, scipy.spatial, scipy.special, scipy.stats
import sqlglot.optimizer, tomlkit, typer, uvicorn, vo_models.uws
failed = []
for room, *names in {rooms}:
    if (child := os.fork()) == 0:
        for name in names:
            __import__(name)
        os._exit(0)
    if os.waitpid(child, 0)[1]:
        failed.append(room)
sys.exit(", ".join(failed) or 0)
"""
"""Import the rooms, each in a process that has other libraries but no module of starcat."""


@pytest.mark.slow
@pytest.mark.timeout(240)
@pytest.mark.skipif(not hasattr(os, "fork"), reason="the system has no fork")
def test_the_modules_of_every_room_import_by_themselves():
    rooms = [
        [room, *(n for n in MODULES if room_of(n) == room and n != "starcat.__main__")]
        for room in [*ROOMS, *PACKAGES]
    ]
    assert all(names for _, *names in rooms)
    printed_by("-c", ROOM_BY_ROOM.format(rooms=rooms))


HEAVY = {"pyarrow", "pandas", "duckdb", "astropy", "scipy", "pydantic", "matplotlib", "erfa"}


MATCHER = [name for name in MODULES if room_of(name) == "matcher"]


def test_every_method_is_a_module_of_the_matcher():
    from starcat.matcher.methods.table import METHODS

    assert {method.propose.__module__ for method in METHODS.values()} <= set(MATCHER)


def test_the_matcher_runs_where_only_numpy_and_h5py_are_installed():
    """So it loads nothing else; its optional libraries are imported on the first call."""
    loaded_by(f"{ONLY_NUMPY_AND_H5PY}\nfor name in {MATCHER}:\n    importlib.import_module(name)")


def test_answers_without_astropy_say_that_it_is_missing():
    loaded_by(f"""{ONLY_NUMPY_AND_H5PY}
from starcat.errors import ConfigError
from starcat.geometry.camera import Camera
from starcat.matcher import sky_objects
from starcat.matcher.stars import NO_STARS
import numpy as np
calls = [
    lambda: sky_objects.wcs(Camera(9, 9, 9.0), np.eye(3)),
    lambda: sky_objects.skycoord(0.0, 0.0),
    lambda: sky_objects.sky_object_table(NO_STARS, {{}}),
]
for call in calls:
    try:
        call()
    except ConfigError as error:
        assert "pip install astropy" in str(error)
    else:
        raise AssertionError""")


def test_the_cli_loads_nothing_heavy_before_it_knows_the_command():
    loaded = loaded_by("import starcat.cli.main")
    assert "typer" in loaded
    assert not loaded & (HEAVY | {"numpy", "h5py", "requests", "pooch"})


@pytest.mark.slow
def test_a_server_starts_without_what_only_some_requests_need():
    """``import scipy`` loads a part when it is first used; ``from scipy.x import`` at once."""
    found = loaded_by("import starcat_service.server", depth=2)
    assert "fastapi" in {name.partition(".")[0] for name in found}
    parts = {f"scipy.{part}" for part in ("ndimage", "optimize", "sparse", "spatial", "special")}
    assert not found & {*parts, "astropy", "duckdb"}


PLUG_INS = (
    "starcat.matcher.methods",
    "starcat.database.products",
    "starcat.pipeline.selection.rules",
    "starcat.catalog.archives",
    "starcat_lab.papers",
)
"""Folders whose modules define functions of the same names, because one protocol calls them."""

MAX_DUPLICATES = 10


def public_definitions(module: str) -> set[str]:
    """Return the public functions and classes that a module defines."""
    kinds = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
    return {
        node.name
        for node in tree_of(module).body
        if isinstance(node, kinds) and node.name[0] != "_"
    }


def test_a_public_name_stands_in_one_module():
    homes: dict[str, list[str]] = {}
    for module in MODULES:
        if module.rpartition(".")[0] not in PLUG_INS:
            for name in public_definitions(module):
                homes.setdefault(name, []).append(module)
    twice = {name: modules for name, modules in homes.items() if len(modules) > 1}
    assert len(twice) <= MAX_DUPLICATES, twice
