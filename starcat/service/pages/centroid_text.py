"""Centroids as somebody pastes them: ``x y`` or ``x y brightness`` a line."""

from __future__ import annotations

import re
from typing import Literal

from starcat.errors import ConfigError, quoted

Brightness = Literal["light", "mag"]

MAX_LINES = 20_000

_SEPARATORS = re.compile(r"[\s,;]+")


def centroid_file(text: str, brightness: Brightness = "light") -> tuple[str, str]:
    r"""Return pasted centroids as a centroid file.

    Examples
    --------
    >>> centroid_file("10.5 20 3000\n30, 40, 1200")
    ('.csv', 'x_px,y_px,flux\n10.5,20,3000\n30,40,1200\n')
    """
    stripped = text.strip()
    if stripped[:1] in ("{", "["):
        return ".json", stripped
    if "x_px" in stripped.partition("\n")[0]:
        return ".csv", stripped + "\n"
    rows = _rows(text)
    if not rows:
        raise ConfigError(
            "no centroid was pasted; give a line 'x y' or 'x y brightness' for each, in pixels",
            key="centroids",
        )
    third = {"light": "flux", "mag": "mag"}[brightness]
    names = ("x_px", "y_px", third)[: len(rows[0])]
    return ".csv", "\n".join(map(",".join, (names, *rows))) + "\n"


def _rows(text: str) -> list[list[str]]:
    rows: list[list[str]] = []
    for number, line in enumerate(text.splitlines(), start=1):
        words = _SEPARATORS.sub(" ", line.partition("#")[0]).split()
        if not words:
            continue
        if len(rows) == MAX_LINES:
            raise ConfigError(
                f"line {number}: more than {MAX_LINES:,} centroids; a frame of so many is no "
                "frame of stars. Leave out the faint ones",
                key="centroids",
            )
        if not (2 <= len(words) <= 3 and all(map(_is_number, words))):
            raise ConfigError(
                f"line {number}: {quoted(line.strip())}; expected two or three numbers, 'x y' or "
                "'x y brightness'",
                key="centroids",
                value=line.strip()[:80],
            )
        if rows and len(words) != len(rows[0]):
            raise ConfigError(
                f"line {number}: {len(words)} numbers, the lines before have {len(rows[0])}; "
                "give all of them a brightness, or none",
                key="centroids",
            )
        rows.append(words)
    return rows


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
