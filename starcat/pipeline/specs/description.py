"""The description of a database: made from its spec, unless its user wrote one."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

from starcat.pipeline.specs.build_spec import BuildSpec

_NUMBER = r"[\d.e+-]+"
_MADE = re.compile(
    rf"Guide stars for (a field of {_NUMBER} x {_NUMBER} deg"
    rf"|fields of {_NUMBER} to {_NUMBER} deg across the width)(, from .*)?"
)
"""Descriptions that starcat has made, also for a first spec (``starcat init``)."""

_DESCRIBED = ("epoch_jyear", "catalog", "selection", "camera", "region")
"""Keys that the descriptions of presets describe, in addition to the widest field."""


def description_of(spec: BuildSpec) -> str:
    """Return a description made from a spec: its fields, its catalogs and its limit.

    Examples
    --------
    >>> from starcat.pipeline.specs import preset
    >>> description_of(preset("sao-6deg"))
    'Guide stars for a field of 6 x 6 deg, from sao, V <= 6.95'
    """
    camera = spec.camera.camera()
    fields = f"a field of {camera.fov_x_deg:.4g} x {camera.fov_y_deg:.4g} deg"
    if spec.is_for_a_range:
        narrowest, widest = spec.fields_deg
        fields = f"fields of {narrowest:.4g} to {widest:.4g} deg across the width"
    band = spec.camera.response.name or spec.catalog.band or "magnitude"
    catalogs = " and ".join(spec.catalog.catalogs)
    limit = spec.selection.faint_limit_mag
    return f"Guide stars for {fields}, from {catalogs}, {band} <= {limit:g}"


def own_description(spec: BuildSpec, presets: Iterable[BuildSpec]) -> str:
    """Return the description of a spec, made again if no user wrote it.

    It is made again if starcat made it, or if it is the description of a preset that differs from
    the spec in a described key.
    """
    is_made = _MADE.fullmatch(spec.description) is not None
    other = next(
        (other_spec for other_spec in presets if other_spec.description == spec.description), None
    )
    is_of_another = (
        bool(spec.description)
        and other is not None
        and _described_values(other) != _described_values(spec)
    )
    return description_of(spec) if is_made or is_of_another else spec.description


def _described_values(spec: BuildSpec) -> tuple[Any, ...]:
    content = spec.model_dump()
    return tuple(content.get(key) for key in _DESCRIBED), spec.fields_deg
