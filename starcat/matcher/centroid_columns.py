"""Columns of centroid tables: their names, what they mean, and where their pixels begin.

Tables of Python and files of every format are read by these names. Capitals do not count. Pixels
of starcat begin at the outer corner of the top-left pixel, so that the centre of this pixel is
(0.5, 0.5). FITS and the programs that follow it call the centre (1, 1), photutils calls it (0, 0);
`POSITIONS` has what is added to each.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from starcat.arguments import numbers_of
from starcat.arrays import Array, Pixels
from starcat.errors import ConfigError, quoted


@dataclass(frozen=True)
class Position:
    """Two columns of positions and what is added to them."""

    x: str
    y: str
    offset_px: float
    writer: str  # the program that calls columns so; empty for names that any program can use
    is_exact: bool = False  # whether capitals count


@dataclass(frozen=True)
class Brightness:
    """A column of magnitudes or of light."""

    name: str
    is_light: bool
    unknown_from: float = np.inf  # magnitudes from here on mean that there is none


POSITIONS = (
    Position("x_px", "y_px", 0.0, "starcat"),
    Position("xwin_image", "ywin_image", -0.5, "SExtractor"),
    Position("x_image", "y_image", -0.5, "SExtractor"),
    Position("xpsf_image", "ypsf_image", -0.5, "SExtractor"),
    Position("x_fit", "y_fit", +0.5, "photutils"),
    Position("x_centroid", "y_centroid", +0.5, "photutils"),
    Position("xcentroid", "ycentroid", +0.5, "photutils"),
    Position("x_center", "y_center", +0.5, "photutils"),
    Position("xcenter", "ycenter", +0.5, "photutils"),
    Position("x_0", "y_0", +0.5, "photutils"),
    Position("x_init", "y_init", +0.5, "photutils"),
    Position("x_peak", "y_peak", +0.5, "photutils"),
    Position("X", "Y", -0.5, "astrometry.net", is_exact=True),
    Position("x", "y", 0.0, ""),
)
"""Columns of positions; the first pair that a table has is used."""

_SEXTRACTOR = ("auto", "best", "psf", "iso", "isocor", "aper")

BRIGHTNESS = (
    Brightness("mag", is_light=False),
    Brightness("magnitude", is_light=False),
    Brightness("flux", is_light=True),
    Brightness("sum", is_light=True),
    *(Brightness(f"mag_{kind}", is_light=False, unknown_from=99.0) for kind in _SEXTRACTOR),
    *(Brightness(f"flux_{kind}", is_light=True) for kind in _SEXTRACTOR),
    *(
        Brightness(name, is_light=True)
        for name in ("flux_fit", "kron_flux", "segment_flux", "aperture_sum", "flux_init")
    ),
)
"""Columns of brightness; the first that a table has is used. Of light, more is brighter."""

PIXELS = "centroids_px"
SIGMA = "sigma_px"
FRAME = "frame"
EXPECTED = (
    "expected the columns x_px and y_px, or the names of photutils, SExtractor or astrometry.net, "
    "and optionally mag or flux, and sigma_px"
)

_WITHOUT_EFFECT = {
    "time": "state the time of frames as an option of the identification",
    "width_px": "the camera of the identification has the size of the frame",
    "height_px": "the camera of the identification has the size of the frame",
}
"""Names that a frame can have, and that have no effect: what to do instead."""

MAX_NAMES = 12
"""Largest number of columns that a message lists."""


@dataclass(frozen=True)
class ChosenColumns:
    """The columns of a table that are read, and the names of all others."""

    position: Position | None  # None if the table has `PIXELS`, pairs of pixels of starcat
    x: str
    y: str
    brightness: Brightness | None
    light: str | None  # name of the column of brightness, as the table has it
    sigma: str | None
    frame: str | None
    unused: tuple[str, ...]

    @property
    def beside(self) -> list[str]:
        """Columns of numbers in addition to the positions; they may lack values."""
        return [name for name in (self.light, self.sigma) if name is not None]

    @property
    def remarks(self) -> tuple[str, ...]:
        """What a user may not expect of these columns, in sentences."""
        sentences = []
        if self.unused:
            text = f"not used: {listed(self.unused)}; used are "
            text += ", ".join(dict.fromkeys([self.x, self.y, *self.beside]))
            if self.light is None:
                text += " (a column of brightness is called mag, magnitude, flux or sum, or as "
                text += "photutils and SExtractor call it)"
            sentences.append(text)
            ineffective = [name for name in self.unused if name.lower() in _WITHOUT_EFFECT]
            advice = dict.fromkeys(_WITHOUT_EFFECT[name.lower()] for name in ineffective)
            if ineffective:
                have = "has" if len(ineffective) == 1 else "have"
                sentences.append(f"{', '.join(ineffective)} {have} no effect: {'; '.join(advice)}")
        if self.position is not None and self.position.writer in ("", "astrometry.net"):
            sentences.append(_assumed(self.position))
        return tuple(sentences)

    def pixels(self, x: Array, y: Array) -> Pixels:
        """Return the positions of two columns as pixels of starcat."""
        offset_px = 0.0 if self.position is None else self.position.offset_px
        return np.column_stack([x, y]) + offset_px

    def magnitudes(self, values: Array) -> Array:
        """Return magnitudes of the column of brightness; NaN for a centroid without light.

        For a column of light they are -2.5 log10 of it, with an unknown zero point.
        """
        if self.brightness is None or not self.brightness.is_light:
            limit = np.inf if self.brightness is None else self.brightness.unknown_from
            return np.where(values >= limit, np.nan, values)
        return np.asarray(-2.5 * np.log10(np.where(values > 0.0, values, np.nan)))


def _assumed(position: Position) -> str:
    if position.writer:
        return (
            f"the columns {position.x} and {position.y} were read as {position.writer} writes "
            "them: the centre of the first pixel is 1, so 0.5 px were subtracted. If it is 0.5, "
            "call them x_px and y_px"
        )
    return (
        f"the columns {position.x} and {position.y} were read as x_px and y_px, in which the "
        "centre of the first pixel is 0.5. If it is 0, as in numpy, add 0.5; if it is 1, as in "
        "FITS, subtract 0.5"
    )


def listed(names: Sequence[str]) -> str:
    """Return names for a message, the first ones if they are many.

    Examples
    --------
    >>> listed(["a", "b"]), listed([f"c{n}" for n in range(14)])[-14:]
    ('a, b', 'c11 and 2 more')
    """
    shown = [name if len(name) <= 40 else quoted(name, 40) for name in names[:MAX_NAMES]]
    more = f" and {len(names) - MAX_NAMES} more" if len(names) > MAX_NAMES else ""
    return (", ".join(shown) + more) or "(none)"


def choose_columns(names: Sequence[str]) -> ChosenColumns | None:
    """Return the columns of a table that are read; None if no columns are known as positions."""
    exact = {name.strip(): name for name in reversed(names)}
    by_name = {name.strip().lower(): name for name in reversed(names)} | {
        name: original for name, original in exact.items() if name == name.lower()
    }

    def find(name: str, *, is_exact: bool = False) -> str | None:
        return exact.get(name) if is_exact else by_name.get(name.lower())

    position, pair = None, (PIXELS, PIXELS)
    if PIXELS not in exact:
        for candidate in POSITIONS:
            x, y = (find(name, is_exact=candidate.is_exact) for name in (candidate.x, candidate.y))
            if x is not None and y is not None:
                position, pair = candidate, (x, y)
                break
        else:
            return None
    matches = (
        (quantity, name) for quantity in BRIGHTNESS if (name := find(quantity.name)) is not None
    )
    brightness, light = next(matches, (None, None))
    sigma, frame = find(SIGMA), find(FRAME)
    used = {*pair, light, sigma, frame}
    if position is None:  # such a frame can have a name
        used.add("name")
    unused = tuple(name for name in names if name not in used)
    return ChosenColumns(position, *pair, brightness, light, sigma, frame, unused)


def columns_of_positions(names: Sequence[str], what: str) -> ChosenColumns:
    """Return the columns of a table that are read; `ConfigError` if there are no positions.

    ``what`` begins the message, such as ``"frame.csv: has"``.
    """
    layout = choose_columns(names)
    if layout is None:
        raise ConfigError(f"{what} the columns {listed(names)}; {EXPECTED}", key=PIXELS)
    return layout


@dataclass(frozen=True, eq=False)
class ColumnValues:
    """The positions, magnitudes and noises that the columns of a table hold."""

    centroids_px: Any  # shape (N, 2), or what a caller has given as such
    mag: Any = None
    sigma_px: Any = None
    frame: Any = None  # names of frames, shape (N,)
    remarks: tuple[str, ...] = ()


def values_of_columns(
    columns: Mapping[str, Any], what: str, wrong_shape: Callable[[str, Array, str], ConfigError]
) -> ColumnValues:
    """Return the values of the columns of a table.

    ``wrong_shape`` makes the error for a column with another number of values.
    """
    # A column of SExtractor can have several apertures; only one value per row is used.
    plain = [name for name, values in columns.items() if name == PIXELS or _is_plain(values)]
    layout = columns_of_positions(plain, what)
    unused = (*layout.unused, *(name for name in columns if name not in plain))
    layout = ChosenColumns(**{**vars(layout), "unused": unused})
    frame = None if layout.frame is None else columns[layout.frame]
    mag = None
    if layout.position is None:
        pixels = columns[PIXELS]
    else:
        x, y = (_numbers(name, "x_px", columns[name]) for name in (layout.x, layout.y))
        if x.ndim != 1 or x.shape != y.shape:
            raise wrong_shape(f"the column {layout.x} has", x, f"(N,), as {layout.y}")
        pixels = layout.pixels(x, y)
    if layout.light is not None and columns[layout.light] is not None:
        mag = columns[layout.light]
        if layout.brightness is None or layout.brightness.is_light:
            mag = _without_unit(mag)
        mag = layout.magnitudes(_numbers(layout.light, "mag", mag))
    sigma_px = None if layout.sigma is None else columns[layout.sigma]
    return ColumnValues(pixels, mag, sigma_px, frame, layout.remarks)


def _is_plain(values: Any) -> bool:
    shape = getattr(values, "shape", None)
    return shape is None or len(shape) <= 1


def _numbers(name: str, unit_like: str, values: Any) -> Array:
    """Return a column as numbers, in the unit that another name states."""
    if getattr(values, "unit", None) is None:
        return numbers_of(name, values, "(N,)")
    try:
        return numbers_of(unit_like, values, "(N,)")
    except ConfigError as error:
        if name == unit_like:
            raise
        error.at(f"the column {name}")
        raise


def _without_unit(values: Any) -> Any:
    """Return a column of light, which can have any unit, without its unit."""
    if getattr(values, "unit", None) is None:
        return values
    plain = np.ma.asarray(getattr(getattr(values, "quantity", values), "value", values))
    return np.ma.array(plain, mask=getattr(values, "mask", False))
