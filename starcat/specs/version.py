"""Names and versions of artifacts: a spec gives them, a registry and a lock file know them.

Patterns are for whole texts. A version is three numbers in ASCII digits without leading zeros,
so that each version has one spelling; 18 digits fit into 64 bits.
"""

from __future__ import annotations

NAME_PATTERN = r"^[a-z0-9][a-z0-9-]{0,63}$"

_NUMBER = r"(0|[1-9][0-9]{0,17})"
VERSION_PATTERN = rf"^{_NUMBER}\.{_NUMBER}\.{_NUMBER}$"


def version_numbers(version: str) -> tuple[int, int, int]:
    """Return what versions are sorted by, as semantic versions go.

    Examples
    --------
    >>> version_numbers("1.10.0") > version_numbers("1.9.0")
    True
    """
    major, minor, patch = (int(number) for number in version.split("."))
    return major, minor, patch
