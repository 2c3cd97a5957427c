"""Sweeps of one artifact that were made one after the other into the same folder.

A sweep is added to what the folder's results hold already, so that the page shows all of them. A
point that is measured again takes the place of the old one, as its record does.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from starcat.artifact.manifest import read_manifest
from starcat.evaluation.trial import code_sha256

Content = Mapping[str, Any]


def with_earlier(results: Path, content: Content, artifact: Path) -> list[dict[str, Any]]:
    """Return a sweep together with those that were made before it."""
    basis = {
        "manifest_sha256": read_manifest(artifact)["manifest_sha256"],
        "code_sha256": code_sha256(),
    }
    new = json.loads(json.dumps({**content, "measured_with": basis}))
    contents = [old for old in _stored(results) if old["measured_with"] == basis]
    for number, old in enumerate(contents):
        if _camera(old) == _camera(new):
            contents[number] = {**new, "name": old["name"], "rows": _merged(old, new)}
            return contents
    taken = {old["name"] for old in contents}
    names = (f"{new['name']}{end}" for end in ("", *(f"-camera-{n}" for n in range(2, 10**6))))
    return [*contents, {**new, "name": next(name for name in names if name not in taken)}]


def _stored(results: Path) -> list[dict[str, Any]]:
    try:
        stored = json.loads(results.read_bytes())["evaluations"]
        return [old for old in stored if {"measured_with", "name", "rows"} <= set(old)]
    except (OSError, ValueError, KeyError, TypeError):
        return []  # there is none, or none of this starcat: it is written anew


def _camera(content: Content) -> Any:
    """Return the camera that the matcher took the frames to be from, the same for all rows."""
    return content["rows"][0]["trial"]["assumed"]


def _merged(old: Content, new: Content) -> list[dict[str, Any]]:
    """Return the rows of both, a new one in place of the old one of its trial, group by group."""
    again = {row["trial"]["name"] for row in new["rows"]}
    rows = [row for row in old["rows"] if row["trial"]["name"] not in again] + [*new["rows"]]
    groups = list(dict.fromkeys(row["group"] for row in (*old["rows"], *new["rows"])))
    methods = list(dict.fromkeys(row["trial"]["method"] for row in rows))
    return sorted(
        rows,
        key=lambda row: (
            groups.index(row["group"]),
            methods.index(row["trial"]["method"]),
            row["x"] if row["x"] is not None else 0.0,
        ),
    )
