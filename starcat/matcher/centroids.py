"""Centroid files: CSV with the columns x_px and y_px (others are ignored)."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from starcat.errors import ConfigError, OutputError, reason

Array = NDArray[np.float64]


def read_centroids(path: Path) -> Array:
    """Read the centroids of one frame.

    Parameters
    ----------
    path : Path
        CSV file with a header that names ``x_px`` and ``y_px``.

    Returns
    -------
    ndarray of float64, shape (N, 2)
        Pixels, in the order of the file.

    Raises
    ------
    ConfigError
        If the file is missing, a column is missing, or a value is not a number, with its line.
    """
    try:
        # Spreadsheets put a mark of the byte order before the header.
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = csv.DictReader(file)
            missing = {"x_px", "y_px"} - set(rows.fieldnames or ())
            if missing:
                raise ConfigError(
                    f"{path}: columns {', '.join(rows.fieldnames or ['none'])}; the header has to "
                    "name x_px and y_px"
                )
            return np.array([_pair(row, path, rows.line_num) for row in rows]).reshape(-1, 2)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({reason(error)})") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(
            f"{path}: not a CSV file ({error}); expected a header with x_px and y_px"
        ) from error


def _pair(row: dict[str, str], path: Path, line: int) -> tuple[float, float]:
    try:
        x, y = float(row["x_px"]), float(row["y_px"])
    except (TypeError, ValueError):
        x = y = math.nan
    if not (math.isfinite(x) and math.isfinite(y)):
        raise ConfigError(
            f"{path}: line {line}: x_px {row['x_px']!r}, y_px {row['y_px']!r}; expected two numbers"
        )
    return x, y


def write_centroids(centroids_px: Array, path: Path) -> None:
    """Write the centroids of one frame.

    Parameters
    ----------
    centroids_px : ndarray of float64, shape (N, 2)
        Pixels.
    path : Path
        CSV file, replaced if it exists.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    try:
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(["x_px", "y_px"])
            writer.writerows([f"{x:.4f}", f"{y:.4f}"] for x, y in centroids_px)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({reason(error)})", path=path) from error
