"""The content of a page as some lines of Python that repeat it, and as a notebook with them."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Notebook:
    """Lines of Python, and an address that contains a notebook of them."""

    name: str  # name of the file, without its suffix
    code: str

    @property
    def address(self) -> str:
        """The notebook as an address that contains it."""
        cell: dict[str, Any] = {
            "cell_type": "code",
            "execution_count": None,
            "id": "starcat",
            "metadata": {},
            "outputs": [],
            "source": self.code.splitlines(keepends=True),
        }
        kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
        content = {
            "cells": [cell],
            "metadata": {"kernelspec": kernel, "language_info": {"name": "python"}},
            "nbformat": 4,
            "nbformat_minor": 5,
        }
        packed = base64.b64encode(json.dumps(content, indent=1).encode()).decode()
        return f"data:application/x-ipynb+json;base64,{packed}"


def _begun(address: str) -> str:
    return (
        "from starcat.client import Client\n\n"
        f"service = Client({json.dumps(address)})  # token='starcat_...', if it asks for one\n"
    )


def database_code(address: str, database_id: str) -> str:
    """Return Python that downloads a database and opens it."""
    return (
        "from pathlib import Path\n\nimport starcat\n"
        + _begun(address)
        + f'folder, _ = service.download("{database_id}", Path("databases"))\n'
        "database = starcat.open(folder)\n"
        'print(database, database.products, sep="\\n")\n'
        "print(database.coverage())\n"
    )


def query_code(
    address: str, targets: list[str], query: str, values: Mapping[str, Any], most: int
) -> str:
    """Return Python that runs an SQL query."""
    text = query.strip().replace("\\", "\\\\").replace('"""', '\\"\\"\\"')
    arguments = f", {dict(values)!r}" if values else ""
    return (
        _begun(address) + f'query = """\n{text}\n"""\n'
        f"answer = service.sql({targets!r}, query{arguments}, max_rows={most})\n"
        'print(*(column["name"] for column in answer["columns"]), sep="\\t")\n'
        'for row in answer["rows"]:\n    print(*row, sep="\\t")\n'
    )


def difference_code(address: str, database_id: str, other_id: str) -> str:
    """Return Python that compares two databases."""
    return (
        _begun(address)
        + f'found = service.difference("{database_id}", "{other_id}")\n'
        + 'print("the same" if found["is_same"] else found["counts"])\n'
        'for kind in ("came", "went"):\n'
        "    for star in found[kind]:\n"
        '        print(kind, star["designation"], star["mag"], star["reason"], sep="\\t")\n'
    )


def identify_code(
    address: str, database_id: str, frame: Mapping[str, Any], options: Mapping[str, Any]
) -> str:
    """Return Python that identifies a frame."""
    return (
        _begun(address) + f"frame = {dict(frame)!r}\n"
        f"options = {dict(options)!r}\n"
        f'answer = service.identify("{database_id}", frame, options)["frames"][0]\n'
        'print(answer["status"], answer.get("boresight_ra_deg"), answer.get("boresight_dec_deg"))\n'
        'for star in answer["stars"]:\n'
        '    print(star["x_px"], star["y_px"], star["star"], star["mag"])\n'
    )
