"""Identified frames on a page: names, files to save, a link that repeats the answer."""

from __future__ import annotations

import base64
import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import urlencode

from starcat.frames.images import WIDE_FOV_ERROR, picture_name
from starcat_service.pages.sky import SkyStar, star_names_of

MAX_LINK = 12_000  # bytes of an address with centroids; the service accepts some more
COLUMNS = (
    *("frame", "x_px", "y_px", "name", "star", "star_id", "mag", "ra_deg", "dec_deg"),
    *("dx_px", "dy_px", "separation_arcsec", "dropped"),
)  # columns of a CSV of answers

REMEDIES = {"mirrored": "camera.flip=on", "scale": f"field_error={100 * WIDE_FOV_ERROR:g}"}
"""Change of the address if a second attempt has found the reason for no answer."""


@dataclass(frozen=True)
class ShownFrame:
    """A frame with everything that a page shows of it."""

    content: dict[str, Any]  # in the form of 'starcat identify --json', with star names
    link: str = ""  # address that repeats the answer; empty if too long
    wcs: str = ""  # FITS header as an address; empty unless identified
    unusable: str = ""  # why the file has no answer
    notes: tuple[str, ...] = ()
    measured: dict[str, Any] = field(default_factory=dict)  # centroids_px, and mag if known

    @property
    def is_identified(self) -> bool:
        """Whether it has an attitude."""
        return bool(self.content["status"] == "identified")

    @property
    def remedy(self) -> str:
        """The address that applies the advice of a refusal; empty if no field of the page can."""
        change = REMEDIES.get(self.content.get("refusal", {}).get("reason", ""), "")
        return f"{self.link}&{change}" if self.link and change else ""

    @property
    def stars(self) -> list[dict[str, Any]]:
        """The spots that are stars."""
        return [star for star in self.content["stars"] if star["star"] is not None]


@dataclass(frozen=True)
class Shown:
    """All frames of a request, with the files that are made from them."""

    database: str
    method: str
    frames: Sequence[ShownFrame]
    first: ShownFrame  # the frame that is shown in full
    json: str = field(init=False)
    csv: str = field(init=False)

    def __post_init__(self) -> None:
        answered = [frame.content for frame in self.frames if not frame.unusable]
        object.__setattr__(self, "json", file_address(json.dumps(answered, indent=1), "json"))
        object.__setattr__(self, "csv", file_address(csv_of(answered), "csv"))

    @property
    def identified(self) -> int:
        """How many frames are identified."""
        return sum(frame.is_identified for frame in self.frames)


def shown_frames(
    answer: Mapping[str, Any], fields: Mapping[str, str], epoch_jyear: float
) -> list[ShownFrame]:
    """Return the frames of a file that was identified."""
    shown: list[ShownFrame] = []
    for content, more in zip(answer["frames"], answer["more"], strict=True):
        _name_stars(content, epoch_jyear)
        measured = _measured(content["stars"], more["mag"])
        shown.append(
            ShownFrame(
                content,
                link_of(measured, fields),
                file_address(more["wcs"], "fits") if more["wcs"] else "",
                notes=tuple(answer["notes"]) if not shown else (),
                measured=measured,
            )
        )
    return shown


def unusable_frame(name: str, why: str) -> ShownFrame:
    """Return what a page shows for a file without an answer."""
    content = {"frame": name, "status": "unusable", "n_matched": 0, "stars": []}
    return ShownFrame(content, unusable=why)


def _name_stars(content: dict[str, Any], epoch_jyear: float) -> None:
    """Give each star the name that the picture shows for it."""
    stars = [star for star in content["stars"] if star["star"] is not None]
    names = star_names_of([{**star, "label": star["star"]} for star in stars], epoch_jyear)
    for star, name in zip(stars, names, strict=True):
        star["name"] = name or picture_name(star["star"])


def _measured(stars: Sequence[Mapping[str, Any]], mag: list[float | None] | None) -> dict[str, Any]:
    """Return the centroids of a frame in the format of programs, to a thousandth of a pixel."""
    spots = [(round(star["x_px"], 3), round(star["y_px"], 3)) if star["x_px"] is not None
             and star["y_px"] is not None else None for star in stars]  # fmt: skip
    measured_k = [k for k, spot in enumerate(spots) if spot is not None]
    measured: dict[str, Any] = {"centroids_px": [list(spots[k] or ()) for k in measured_k]}
    if mag is not None and all(mag[k] is not None for k in measured_k):
        measured["mag"] = [round(mag[k] or 0.0, 3) for k in measured_k]
    return measured


def link_of(measured: Mapping[str, Any], fields: Mapping[str, str]) -> str:
    """Return the address that repeats an answer: it contains the measured centroids."""
    values = {name: text for name, text in fields.items() if text}
    if not values.get("seed"):
        lines = [f"{x:.8g} {y:.8g}" for x, y in measured["centroids_px"]]
        if "mag" in measured:
            lines = [f"{line} {m:g}" for line, m in zip(lines, measured["mag"], strict=True)]
        values |= {"centroids": "\n".join(lines), "brightness": "mag" * ("mag" in measured)}
        values.pop("camera.flip", None)  # measured y always counts down
    query = urlencode({name: text for name, text in values.items() if text})
    return f"/identify?{query}" if len(query) <= MAX_LINK else ""


def csv_of(contents: Sequence[Mapping[str, Any]]) -> str:
    """Return the spots of frames as CSV, one line per spot."""
    file = io.StringIO()
    writer = csv.DictWriter(file, COLUMNS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for content in contents:
        writer.writerows({"frame": content["frame"], **star} for star in content["stars"])
    return file.getvalue()


def marks_of(frame: ShownFrame) -> list[SkyStar]:
    """Return the stars of a frame for the view of the sky."""
    return [
        SkyStar(
            label=star["star"],
            ra_deg=star["ra_deg"],
            dec_deg=star["dec_deg"],
            mag=star["mag"],
            id=star["star_id"],
            name=star["name"],
            reason=f"matched, {star['separation_arcsec']:.1f} arcsec off",
        )
        for star in frame.stars
    ]


_KINDS = {"json": "application/json", "csv": "text/csv", "fits": "application/fits"}


def file_address(text: str, kind: str) -> str:
    """Return a file as an address that contains it: the service stores nothing of a frame."""
    return f"data:{_KINDS[kind]};base64,{base64.b64encode(text.encode()).decode()}"
