# SPDX-License-Identifier: MIT
"""Compile the C matcher for Python when a wheel is built or starcat is installed in place.

Hatchling runs the hook for both distributions. ``starcat-matcher`` gets only the modules that
identification imports; ``starcat-guide-stars`` gets all modules. Without a compiler, or if
``STARCAT_WITHOUT_C`` is set, the wheel is pure Python and uses only the numpy matcher.
"""

from __future__ import annotations

import ast
import os
import re
import sys
import sysconfig
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
ONBOARD = ROOT / "onboard"
MODULE = "starcat.matcher._onboard"
DEFINED = {"STARCAT_MAX_CENTROIDS": "512", "STARCAT_MAX_STARS": "8192"}
"""Ground software has memory for wider and denser fields than an onboard computer."""

UNIX_ARGUMENTS = ["-O3", "-std=gnu99", "-fvisibility=hidden"]

BEGINNINGS = ("starcat/__main__.py", "starcat/cli/alone.py")
"""Entry points of ``starcat-matcher``, besides the modules of the matcher themselves."""


class CompileHook(BuildHookInterface):  # type: ignore[type-arg]
    """Compiles the extension next to the module that imports it."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile; if that succeeds, make the wheel one for this platform."""
        if self.target_name != "wheel":
            return
        if is_matcher := self.metadata.name == "starcat-matcher":
            build_data["force_include"] |= files_of_the_matcher()
        try:
            compiled = compile_binding()
        except Exception as error:
            self.app.display_warning(
                f"starcat: the C matcher was not compiled ({error}); the numpy matcher is used"
            )
            return
        build_data["pure_python"] = False
        build_data["tag"] = f"cp311-abi3-{re.sub('[-.]', '_', sysconfig.get_platform())}"
        name = compiled.relative_to(ROOT).as_posix()
        if is_matcher:
            build_data["force_include"][str(compiled)] = name
        else:
            build_data["artifacts"].append(name)


def files_of_the_matcher() -> dict[str, str]:
    """Return the files of the distribution that only identifies, by path, with their new names."""
    names = {"starcat/py.typed": "starcat/py.typed", "LICENSE": "starcat/LICENSE"}
    names |= {name: name for name in sorted(modules_of_the_matcher())}
    # `starcat.storage.schema` reads the columns of products.
    schemas = sorted((ROOT / "schemas").glob("*.json"))
    names |= {f"schemas/{path.name}": f"starcat/schemas/{path.name}" for path in schemas}
    return {str(ROOT / old): new for old, new in names.items()}


def modules_of_the_matcher() -> set[str]:
    """Return the modules that the entry points and the matcher import, as paths from the root."""
    matcher = (ROOT / "starcat" / "matcher").rglob("*.py")
    left = [*BEGINNINGS, *(path.relative_to(ROOT).as_posix() for path in matcher)]
    found: set[str] = set()
    while left:
        name = left.pop()
        if name in found or not (ROOT / name).is_file():
            continue
        found.add(name)
        left += [str(Path(name).parent.as_posix()) + "/__init__.py"]
        left += imported_by(ast.parse((ROOT / name).read_text(encoding="utf-8")))
    return found


def imported_by(tree: ast.Module) -> list[str]:
    """Return the modules that a module imports at import time: not for types, not in functions."""
    found = []
    for node in tree.body:
        names = []
        if isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        for name in names:
            if name.split(".")[0] == "starcat":
                path = name.replace(".", "/")
                found += [f"{path}.py", f"{path}/__init__.py"]
    return found


def compile_binding() -> Path:
    """Compile the extension into the source tree.

    Returns
    -------
    Path
        The file, which any CPython from 3.11 on can import.

    Raises
    ------
    Exception
        Any error of cffi or setuptools if a compiler is missing or fails.
    """
    if os.environ.get("STARCAT_WITHOUT_C"):
        raise RuntimeError("STARCAT_WITHOUT_C is set")
    from cffi import FFI

    ffi = FFI()
    # The parser of cffi cannot read #include: binding.h has the few lines that Python uses.
    ffi.cdef((HERE / "binding.h").read_text(encoding="utf-8"))
    sources = [*sorted((ONBOARD / "src").glob("*.c")), HERE / "many.c"]
    ffi.set_source(
        MODULE,
        # As one file, so that the compiler can inline functions: a call takes a seventh less time.
        "".join(f'#include "{source.name}"\n' for source in sources),
        include_dirs=[str(ONBOARD / "include"), str(ONBOARD / "src"), str(HERE)],
        define_macros=list(DEFINED.items()),
        extra_compile_args=[] if sys.platform == "win32" else UNIX_ARGUMENTS,
        py_limited_api=True,
    )
    target = ROOT.joinpath(*MODULE.split("."))
    with tempfile.TemporaryDirectory() as folder:
        built = Path(ffi.compile(tmpdir=folder, verbose=False))
        compiled = target.with_name(built.name)
        # Under another name first: a running process can have the present file mapped.
        copy = compiled.with_suffix(".partial")
        copy.write_bytes(built.read_bytes())
        copy.replace(compiled)
    return compiled


if __name__ == "__main__":
    compile_binding()
