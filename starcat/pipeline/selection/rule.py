"""Parts of the rules of selection: reasons, rejections, the context, fields of a form."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import pyarrow as pa

from starcat.arrays import Mask
from starcat.catalog.stars.verdict import Verdicts


@dataclass(frozen=True)
class RuleReason:
    """Why a rule rejects a star."""

    name: str  # the value of the column ``reason`` of the product ``rejected``
    value: str  # the reason in words, for pages and reports


@dataclass(frozen=True)
class Rejection:
    """The stars that a rule rejects for one reason."""

    where: Mask
    reason: RuleReason
    detail: str | None = None  # goes into the column ``detail`` of the product ``rejected``


@dataclass
class Context:
    """The data that rules read and change while they run in turn."""

    catalog: pa.Table  # the star table as it was read
    stars: pa.Table  # the same rows, as the rules that combine stars have changed them
    verdicts: Verdicts  # the verdicts of the rules before
    selection: Any  # section [selection] of the spec
    pixel_arcsec: float | None  # side of a pixel at the camera's axis
    tallies: dict[str, Any] = field(default_factory=dict)  # figures for the report, by table


@dataclass(frozen=True)
class FormField:
    """How the form of the service shows a key of a rule."""

    label: str
    kind: Literal["slide", "number", "choice", "text"]
    group: Literal["limits", "sensor"] = "sensor"  # the card that it stands in
    hint: str = ""
    placeholder: str = ""
    low: float = 0.0  # ends and step of a slide
    high: float = 1.0
    step: float = 0.1
    scale: Literal["linear", "log"] = "linear"
    none_at: Literal["", "low", "high"] = ""  # the end of a slide at which there is no limit
    choices: tuple[tuple[str, str], ...] = ()  # value and words
