"""What a design is called where nobody has named it: by its catalog, its limit, its camera."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cache
from typing import Any

from pydantic import ValidationError

from starcat.specs.build_spec import BuildSpec, CameraSpec
from starcat.specs.reading import preset, preset_names

_OWN = {
    "name": re.compile(r"[a-z0-9_]+-[0-9]+(-[0-9]+)?deg"),
    "description": re.compile(
        r"\w+, \S+ <= [-.0-9]+, for a [.0-9]+ x [.0-9]+ deg camera of [0-9]+ x [0-9]+ px"
    ),
}
"""What `names_of` gives."""

FOLLOWING = tuple(_OWN)
"""Keys that follow the design."""


def followed(content: Mapping[str, Any]) -> dict[str, str]:
    """Return the name and the description that a changed spec should have, where it has given none.

    That of a preset stays while what it tells is true.
    """
    names = names_of(content)
    found = {}
    for key, own in _OWN.items():
        said = value_at(content, key)
        if key not in names or not isinstance(said, str):
            continue
        of_preset = _of_presets(key).get(said)
        if names[key] != of_preset if of_preset else own.fullmatch(said):
            found[key] = names[key]
    return {key: text for key, text in found.items() if text != value_at(content, key)}


def names_of(content: Mapping[str, Any]) -> dict[str, str]:
    """Return a name and a description; none where the camera or the limit is not known.

    Examples
    --------
    >>> names_of({"catalog": {"source": "gaia", "band": "G"}, "selection": {"faint_limit_mag": 6.2},
    ...          "camera": {"width_px": 1000, "height_px": 500, "fov_x_deg": 20.0}})["name"]
    'gaia-20deg'
    """
    source, limit = (
        value_at(content, "catalog.source"),
        value_at(content, "selection.faint_limit_mag"),
    )
    try:
        camera = CameraSpec.model_validate(value_at(content, "camera")).camera()
    except (ValidationError, ValueError):
        return {}
    is_number = isinstance(limit, int | float) and not isinstance(limit, bool)
    if not isinstance(source, str) or not is_number or not abs(limit) < 100.0:
        return {}
    width = f"{camera.fov_x_deg:.3g}".replace(".", "-")
    band = value_at(content, "camera.response.name") or value_at(content, "catalog.band")
    limit_text = f"{band or 'magnitude'} <= {limit:.4g}"
    return {
        "name": f"{source}-{width}deg",
        "description": f"{source}, {limit_text}, for a {camera.fov_x_deg:.4g} x "
        f"{camera.fov_y_deg:.4g} deg camera of {camera.width_px} x {camera.height_px} px",
    }


@cache
def _of_presets(key: str) -> Mapping[str, str]:
    """Return by the name or the description of each preset what it would be called."""
    specs: list[BuildSpec] = [preset(name) for name in preset_names()]
    return {getattr(spec, key): names_of(spec.recorded()).get(key, "") for spec in specs}


def value_at(content: Mapping[str, Any], path: str) -> Any:
    """Return the value of a dotted key; None where there is none."""
    value: Any = content
    for name in path.split("."):
        if not isinstance(value, Mapping):
            return None
        value = value.get(name)
    return value
