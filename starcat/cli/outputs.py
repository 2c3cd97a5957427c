"""The rule of ``-o``, the same for every command that writes.

A command that makes one file takes the name of a file, and its suffix selects the format. A
command that makes several files takes a folder. Existing files are replaced only with
``--replace``; without it the command refuses before it computes anything.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

import typer

from starcat.errors import OutputError


def _no_file(path: Path | None) -> Path | None:
    if path is not None and path.is_file():
        raise OutputError("is a file", where=path, hint="choose a folder with --output")
    return path


def _no_folder(path: Path | None) -> Path | None:
    if path is not None and path.is_dir():
        raise OutputError("is a folder", where=path, hint="choose a file with --output")
    return path


def to_folder(what: str) -> Any:
    """Return the option ``-o`` of a command that writes into a folder."""
    return typer.Option("--output", "-o", metavar="FOLDER", callback=_no_file, help=what)


def to_file(what: str) -> Any:
    """Return the option ``-o`` of a command that writes a file."""
    return typer.Option("--output", "-o", metavar="FILE", callback=_no_folder, help=what)


def to_either(what: str) -> Any:
    """Return the option ``-o`` of a command that writes a file or a folder, by the format."""
    return typer.Option("--output", "-o", metavar="FILE|FOLDER", help=what)


Replace = Annotated[bool, typer.Option("--replace", help="Replace an existing file or folder.")]


def expect_free(*paths: Path | None, replace: bool) -> None:
    """Raise `OutputError` if an output exists and may not be replaced; an empty folder is free."""
    for path in paths:
        if path is None or replace or not path.exists():
            continue
        if path.is_file() or (path.is_dir() and any(path.iterdir())):
            raise OutputError(
                f"{path} already exists",
                path=path,
                hint="choose another --output, or pass --replace",
            )


def expect_room(**paths: Path | None) -> None:
    """Raise `OutputError` if a file cannot be written for an option, before the work for it."""
    for option, path in paths.items():
        if path is None:
            continue
        name, folder = f"--{option.replace('_', '-')}", path.parent
        if path.is_dir():
            raise OutputError(f"{name} {path}: is a folder", path=path, hint="choose a file")
        if not folder.is_dir():
            raise OutputError(
                f"{name} {path}: {folder} is not a folder",
                path=path,
                hint="make it, or choose another",
            )
        if not os.access(path if path.exists() else folder, os.W_OK):
            raise OutputError(
                f"{name} {path}: cannot be written", path=path, hint="choose another file"
            )
