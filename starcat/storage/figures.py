"""Drawings of matplotlib as PNG or SVG files, the same bytes on every machine."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starcat.errors import ConfigError
from starcat.storage.atomic import write_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure

KINDS = (".png", ".svg")

_STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",  # comes with matplotlib
    "font.size": 9.0,
    "svg.hashsalt": "starcat",
}
_DPI = 100


@contextmanager
def own_style(more: Mapping[Any, Any] | None = None) -> Iterator[None]:
    """Draw with matplotlib's defaults and our style, then put everything back."""
    import matplotlib

    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update({**_STYLE, **(more or {})})
        yield


def figure_bytes(figure: Figure, suffix: str, dpi: int = _DPI) -> bytes:
    """Return a drawing as a file of the kind that a suffix names."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    buffer = io.BytesIO()
    if suffix.lower() == ".png":
        FigureCanvasAgg(figure).print_figure(buffer, dpi=dpi, metadata={"Software": None})
    else:
        nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        FigureCanvasSVG(figure).print_figure(buffer, metadata=nothing)
    return buffer.getvalue()


def write_figure(figure: Figure, path: Path, dpi: int = _DPI) -> None:
    """Write a drawing as its name says, PNG or SVG."""
    write_file(path, figure_bytes(figure, path.suffix, dpi))


def check_kind(path: Path | None, what: str = "plot") -> None:
    """Refuse a name that is neither PNG nor SVG, before the work for it is done."""
    if path is not None and path.suffix.lower() not in KINDS:
        raise ConfigError(
            f"a {what} is one of {', '.join(KINDS)}", where=path, hint="choose another name"
        )
