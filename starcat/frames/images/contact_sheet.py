"""One picture of many frames: a tile for each, with rings at identified stars and a caption."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from starcat.errors import ConfigError
from starcat.frames.images.batch import TILE_PX, BatchItem
from starcat.frames.images.overlay import LOST, SKY, STAR
from starcat.matcher.result import MatchResult
from starcat.storage.atomic import write_file

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageDraw import ImageDraw

SUFFIX = ".png"
_GAP_PX, _TEXT_PX, _LINES = 10, 12, 3
_RING_PX = 4.0
_WHITE, _PAPER = "#f4fbfd", "#1a2233"
_WIDEST = 10  # tiles in a row


def check_sheet(path: Path | None) -> None:
    """Refuse a name that is not a PNG file, before the work starts."""
    if path is not None and path.suffix.lower() != SUFFIX:
        raise ConfigError(
            f"a contact sheet is a {SUFFIX} file", where=path, hint="choose another name"
        )


def write_contact_sheet(path: Path, items: Sequence[BatchItem]) -> None:
    """Draw the files of a batch as tiles of one picture; the same bytes for the same files."""
    from PIL import Image, ImageDraw, ImageFont

    columns = min(_WIDEST, max(1, int(np.ceil(np.sqrt(1.4 * len(items))))))
    rows = -(-len(items) // columns)
    wide, high = TILE_PX + _GAP_PX, TILE_PX + _GAP_PX + _LINES * (_TEXT_PX + 2)
    sheet = Image.new("RGB", (columns * wide + _GAP_PX, rows * high + _GAP_PX), _PAPER)
    draw = ImageDraw.Draw(sheet)
    draw.font = ImageFont.load_default(_TEXT_PX)
    for number, item in enumerate(items):
        row, column = divmod(number, columns)
        _draw_tile(sheet, draw, item, (_GAP_PX + column * wide, _GAP_PX + row * high))
    buffer = io.BytesIO()
    sheet.save(buffer, format="PNG")
    write_file(path, buffer.getvalue())


def _draw_tile(sheet: Image, draw: ImageDraw, item: BatchItem, corner: tuple[int, int]) -> None:
    from PIL import Image

    left_px, top_px = corner
    draw.rectangle((left_px, top_px, left_px + TILE_PX - 1, top_px + TILE_PX - 1), fill=SKY)
    if item.small is not None:
        sheet.paste(Image.fromarray(item.small), corner)
    first = item.answers[0] if item.answers else None
    result = None if first is None else first.result
    if first is not None and result is not None and result.ok and result.camera is not None:
        scale = TILE_PX / max(result.camera.width_px, result.camera.height_px)
        if item.small is not None:
            scale = item.small.shape[1] / result.camera.width_px
        for x, y in (scale * first.frame.centroids_px[result.star_index >= 0]).tolist():
            ring = (
                left_px + x - _RING_PX,
                top_px + y - _RING_PX,
                left_px + x + _RING_PX,
                top_px + y + _RING_PX,
            )
            draw.ellipse(ring, outline=STAR)
    else:
        draw.rectangle(
            (left_px, top_px, left_px + TILE_PX - 1, top_px + TILE_PX - 1), outline=LOST, width=2
        )
    for line, text in enumerate(_said(item, result)):
        fill = _WHITE if line == 0 else STAR if result is not None and result.ok else LOST
        at_px = left_px, top_px + TILE_PX + 2 + line * (_TEXT_PX + 2)
        draw.text(at_px, _fitting(draw, text), fill=fill)


def _said(item: BatchItem, result: MatchResult | None) -> tuple[str, ...]:
    if result is None:
        return item.path.name, "cannot be used"
    if not result.ok:
        why = result.status if result.refusal is None else result.refusal.reason
        return item.path.name, why.replace("_", " ")
    more = f" and {len(item.answers) - 1} more frames" if len(item.answers) > 1 else ""
    return (
        item.path.name,
        f"RA {result.boresight_ra_deg:.3f} Dec {result.boresight_dec_deg:+.3f}",
        f"roll {result.roll_deg:.2f}, {result.n_matched} stars{more}",
    )


def _fitting(draw: ImageDraw, text: str) -> str:
    """Return a text that is as wide as a tile at most."""
    if draw.textlength(text) <= TILE_PX:
        return text
    while text and draw.textlength(text + "...") > TILE_PX:
        text = text[:-1]
    return text + "..."
