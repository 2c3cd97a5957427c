"""Digests of files, and the one form of JSON that is digested."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any


def file_sha256(path: Path) -> str:
    """Return the digest of a file.

    Parameters
    ----------
    path : Path
        The file.

    Returns
    -------
    str
        SHA-256, hexadecimal.
    """
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def json_bytes(content: Any) -> bytes:
    """Return a value as JSON with sorted keys, the same bytes for the same value.

    Parameters
    ----------
    content : object
        Dicts, lists, texts, numbers.

    Returns
    -------
    bytes
        UTF-8, indented, with a final newline.
    """
    text = json.dumps(content, indent=2, sort_keys=True, ensure_ascii=False, allow_nan=False)
    return text.encode() + b"\n"
