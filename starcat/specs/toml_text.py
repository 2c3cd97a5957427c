"""TOML out of texts that anybody may have sent: read in a time that their length bounds."""

from __future__ import annotations

import tomllib
from typing import Any

MOST_DOTS = 300
"""Full stops in a line at most: a key with 20,000 parts takes the parser of Python 12 s."""


def read_toml(text: str) -> dict[str, Any]:
    """Read TOML.

    Parameters
    ----------
    text : str
        Perhaps not TOML.

    Returns
    -------
    dict
        Its keys.

    Raises
    ------
    ValueError
        If it is not TOML, nests too deeply, or has more than `MOST_DOTS` full stops in a line.
    """
    for number, line in enumerate(text.split("\n"), 1):
        if line.count(".") > MOST_DOTS:
            raise ValueError(
                f"line {number} has more than {MOST_DOTS} full stops; write long lists on several "
                "lines"
            )
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("brackets within brackets within brackets, too deep to be read") from None
