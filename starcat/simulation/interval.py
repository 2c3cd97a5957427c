"""The interval in which a rate lies that was measured on some frames."""

from __future__ import annotations

Z95 = 1.959963984540054
"""Standard deviations of a two-sided interval of 95 %."""


def wilson_interval(hits: int, count: int) -> tuple[float, float]:
    """Return Wilson's interval of 95 % of a share.

    References
    ----------
    Wilson 1927, Journal of the American Statistical Association 22, 209.

    Examples
    --------
    >>> [round(end, 3) for end in wilson_interval(88, 100)]
    [0.802, 0.93]
    """
    if not count:
        return 0.0, 1.0
    p, n, z2 = hits / count, count, Z95 * Z95
    middle = (p + 0.5 * z2 / n) / (1.0 + z2 / n)
    half = Z95 / (1.0 + z2 / n) * (p * (1.0 - p) / n + 0.25 * z2 / (n * n)) ** 0.5
    return max(0.0, middle - half), min(1.0, middle + half)
