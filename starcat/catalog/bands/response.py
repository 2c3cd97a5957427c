"""Responses: how strongly a sensor, or a catalog's passband, answers light of each wavelength.

A response is a curve of any scale, per photon (quantum efficiency) or per energy (A/W). The
responses that ship with starcat are files of ``data/responses``, whose first lines state their
titles and zero points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Literal, cast

import numpy as np

from starcat.arrays import Array
from starcat.errors import ConfigError, FileMissing, SourceError, quoted, suggest
from starcat.resources import resource_folder
from starcat.storage.regular_files import read_regular_file

Counts = Literal["photon", "energy"]
"""Quantity that a response is relative to."""

LIMITS_NM = (300.0, 2500.0)
"""Wavelengths that the spectra cover."""

MAX_ROWS = 20_000
MAX_BYTES = 4_000_000
"""Largest size of the CSV file of a response."""

WIDEST_GAP_NM = 100.0
"""A curve whose rows are further apart than this is refused."""

MAX_OUTSIDE = 0.01
"""Largest share of a response outside of the wavelengths of the spectra."""


@dataclass(frozen=True)
class Response:
    """A response by wavelength, and the zero point of magnitudes in its band."""

    name: str
    title: str
    wavelength_nm: Array  # shape (N,), rising
    value: Array  # shape (N,), any scale, not negative
    counts: Counts
    # "vega M": Vega has M mag; "ab M": an AB magnitude of M is 0; "type T": a star of the
    # spectral type T has the magnitude that it has in V
    zero_point: str = "vega 0"
    source: str = ""

    def photon_efficiency(self, wavelength_nm: Array) -> Array:
        """Return electrons per photon at wavelengths, in units of the peak."""
        value = np.interp(wavelength_nm, self.wavelength_nm, self.value, left=0.0, right=0.0)
        if self.counts == "energy":
            value = value / wavelength_nm
        return np.asarray(value / value.max())

    @property
    def mean_nm(self) -> float:
        """The mean wavelength, weighted by electrons per photon."""
        at = np.arange(LIMITS_NM[0], LIMITS_NM[1])
        weight = self.photon_efficiency(at)
        return float(np.sum(weight * at) / np.sum(weight))

    def named(self, title: str, zero_point: str) -> Response:
        """Return the response with another title and zero point."""
        return replace(self, title=title, zero_point=zero_point)

    def behind(self, optics: Response) -> Response:
        """Return the response behind optics of some transmission."""
        wavelength = np.union1d(self.wavelength_nm, optics.wavelength_nm)
        passed = np.interp(
            wavelength, optics.wavelength_nm, optics.value, left=0.0, right=0.0
        ) * np.interp(wavelength, self.wavelength_nm, self.value, left=0.0, right=0.0)
        if not passed.any():
            raise ConfigError(
                f"its optics let nothing through that it answers to; it answers "
                f"{_range(self)} and the optics pass {_range(optics)}",
                where=self.name,
                key="optics",
                hint="Check the units",
            )
        return replace(self, wavelength_nm=wavelength, value=passed)


def _range(response: Response) -> str:
    lit = response.wavelength_nm[response.value > 0]
    return f"{lit[0]:g} to {lit[-1]:g} nm"


def checked_response(
    name: str, wavelength_nm: Sequence[float] | Array, value: Sequence[float] | Array,
    counts: Counts, zero_point: str = "vega 0", *, title: str = "", source: str = "",
) -> Response:  # fmt: skip
    """Return a response from a table; ConfigError for a table that is not valid."""
    wavelength = np.asarray(wavelength_nm, dtype=np.float64)
    response = np.asarray(value, dtype=np.float64)
    fault = _fault(wavelength, response)
    if fault:
        raise ConfigError(f"response {name}: {fault}", key="response", value=name)
    return Response(name, title or name, wavelength, response, counts, zero_point, source)


def _fault(wavelength: Array, value: Array) -> str | None:
    """Return the fault of a table of a response, or None."""
    if len(wavelength) != len(value):
        return (
            f"{len(wavelength)} wavelengths and {len(value)} values; every wavelength needs one "
            "value"
        )
    if not 3 <= len(wavelength) <= MAX_ROWS:
        return f"{len(wavelength)} wavelengths; a curve needs at least 3 and at most {MAX_ROWS:,}"
    missing = ~(np.isfinite(wavelength) & np.isfinite(value))
    if missing.any():
        row = int(np.argmax(missing)) + 1
        return f"row {row} has no number; fill the gap, or leave the row out"
    fault = _fault_of_units(wavelength)
    if fault:
        return fault
    if (value < 0).any():
        row = int(np.argmax(value < 0))
        return (
            f"{value[row]:g} at {wavelength[row]:g} nm; a response is not negative. Set what the "
            "measurement's noise made negative to 0"
        )
    if not value.any():
        return "all values are 0; a response answers to some light"
    steps = np.diff(wavelength)
    lit = (value[1:] > 0) | (value[:-1] > 0)
    wide = lit & (steps > WIDEST_GAP_NM)
    if wide.any():
        row = int(np.argmax(wide))
        return (
            f"nothing between {wavelength[row]:g} and {wavelength[row + 1]:g} nm; a gap of more "
            f"than {WIDEST_GAP_NM:g} nm leaves the curve open. Add rows there"
        )
    return _fault_of_coverage(wavelength, value)


def _fault_of_units(wavelength: Array) -> str | None:
    low, high = float(wavelength.min()), float(wavelength.max())
    beginning = f"wavelengths from {low:g} to {high:g}; they are in nm"
    if high < 30.0:
        return f"{beginning}, and these look like micrometres: multiply them by 1000"
    if low > LIMITS_NM[1] or high > 4.0 * LIMITS_NM[1]:
        return f"{beginning}, and these look like angstroms: divide them by 10"
    if (np.diff(wavelength) <= 0).any():
        row = int(np.argmax(np.diff(wavelength) <= 0))
        return (
            f"{wavelength[row]:g} nm is followed by {wavelength[row + 1]:g} nm; sort the rows by "
            "rising wavelength, each once"
        )
    return None


def _fault_of_coverage(wavelength: Array, value: Array) -> str | None:
    low, high = LIMITS_NM
    fine = np.linspace(wavelength[0], wavelength[-1], 20_001)
    response = np.interp(fine, wavelength, value)
    outside = float(response[(fine < low) | (fine > high)].sum() / response.sum())
    if outside <= MAX_OUTSIDE:
        return None
    return (
        f"{outside:.0%} of it is outside of {low:g} to {high:g} nm, which the spectra cover, so "
        "catalog bands cannot predict its magnitudes. Check the units, or cut it there"
    )


def response_from_text(name: str, text: str, counts: Counts | None) -> Response:
    """Return a response from the text of a CSV file: a wavelength in nm and a value per row.

    Lines that begin with # are remarks; ``# counts:``, ``# title:``, ``# zero_point:`` and
    ``# source:`` are read. A header line can precede the numbers.
    """
    remarks: dict[str, str] = {}
    rows: list[tuple[float, float]] = []
    for number, line in enumerate(text.splitlines(), start=1):
        if line.startswith("#"):
            key, _, value = line[1:].partition(":")
            remarks[key.strip()] = value.strip()
        elif line.strip():
            row = _row(name, number, line, is_first=not rows)
            rows += [row] if row else []
    basis = counts or remarks.get("counts", "")
    if basis not in ("photon", "energy"):
        raise ConfigError(
            f"response {name}: it does not state what it is relative to",
            key="per",
            hint='set {per:"photon"} (quantum efficiency) or {per:"energy"} (A/W)',
        )
    columns = np.array(rows, dtype=np.float64).reshape(-1, 2)
    return checked_response(
        name,
        columns[:, 0],
        columns[:, 1],
        cast("Counts", basis),
        remarks.get("zero_point", "vega 0"),
        title=remarks.get("title", ""),
        source=remarks.get("source", ""),
    )


def read_response(path: Path, per: str | None) -> Response:
    """Return the response of a CSV file; ``per`` states what its values are relative to."""
    try:
        text = read_regular_file(path, MAX_BYTES).decode("utf-8")
    except FileMissing:
        raise FileMissing(
            f"no such response; these ship with starcat: {', '.join(shipped_names())}", where=path
        ) from None
    except SourceError as error:
        raise ConfigError(f"{error}; expected a CSV file", key="response") from error
    except UnicodeDecodeError as error:
        raise ConfigError(
            f"not a readable CSV file: {error}", where=path, key="response"
        ) from error
    if per not in (None, "photon", "energy"):
        raise ConfigError("choose photon or energy", parameter="per", value=per)
    return response_from_text(path.stem, text, cast("Counts | None", per))


def _row(name: str, number: int, line: str, *, is_first: bool) -> tuple[float, float] | None:
    """Return the two numbers of a line; None for the header."""
    cells = [cell.strip() for cell in line.replace(";", ",").split(",")]
    try:
        if len(cells) == 2:
            return float(cells[0]), float(cells[1] or "nan")
    except ValueError:
        if is_first and "nm" in line.lower():
            return None
        if is_first and any(unit in line.lower() for unit in ("angstrom", "micro", "um")):
            raise ConfigError(
                f"response {name}: line {number}: found {quoted(line)}; wavelengths are in nm, and "
                "the header is wavelength_nm,response",
                key="response",
            ) from None
        if is_first and not any(cell[:1].isdigit() for cell in cells):
            return None
    raise ConfigError(
        f"response {name}: line {number}: found {quoted(line)}; expected a wavelength in nm, a "
        "comma and a value",
        key="response",
    )


@cache
def shipped_names() -> tuple[str, ...]:
    """Return the names of the responses that ship with starcat: sensors first, then passbands."""
    names = [path.stem for path in resource_folder("catalog/bands/data/responses").glob("*.csv")]
    return tuple(sorted(names, key=lambda name: (not name.islower(), shipped(name).mean_nm)))


@cache
def shipped(name: str) -> Response:
    """Return a response that ships with starcat."""
    folder: Path = resource_folder("catalog/bands/data/responses")
    names = sorted(path.stem for path in folder.glob("*.csv"))
    if name not in names:
        hint = suggest(name, names)
        raise ConfigError(
            f"unknown response {name!r}; {hint}known ones: {', '.join(names)}",
            key="response",
            value=name,
            hint="A response of your own is a CSV file that a spec names: [camera.response] file "
            '= "sensor.csv"',
        )
    return response_from_text(name, (folder / f"{name}.csv").read_text(encoding="utf-8"), None)
