"""A spec on its way: the fields of a form and the text of a TOML file as two views of one thing.

The text is what counts. A form that comes back with the text as it was given changes the keys that
it has fields for and leaves all others; with a text that was edited, the fields follow the text.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from starcat.catalog.source import data_source, source_names
from starcat.errors import ConfigError, StarcatError
from starcat.specs.build_spec import BuildSpec
from starcat.specs.keys import REQUIRED, SpecKey, spec_sections, toml_value
from starcat.specs.reading import content_of_toml, spec_from_dict

ORIGIN = "spec"
"""What messages call the text."""

TEXT = "toml"
BEFORE = "toml-before"
LENS = "lens"
ENABLED = "enabled"

FIELDS = (
    "name",
    "version",
    "epoch_jyear",
    "catalog.source",
    "catalog.band",
    "camera.width_px",
    "camera.height_px",
    "camera.fov_x_deg",
    "camera.focal_length_mm",
    "camera.pixel_um",
    "selection.faint_limit_mag",
    "selection.bright_limit_mag",
    "selection.max_stars_per_field",
    "selection.doubles.min_separation_deg",
    "selection.doubles.action",
    "boresights.count",
    "boresights.brightest",
)
"""Keys that the form has a field for, by the same names."""

PRODUCTS = (
    "pairs",
    "triangles",
    "neighbours",
    "hausdorff_angular",
    "hausdorff_l2",
    "grid",
    "radial",
)
"""Products that the form has a box for."""

_OF_LENS = {
    "field": ("camera.focal_length_mm", "camera.pixel_um"),
    "focal": ("camera.fov_x_deg",),
}
"""What goes away where a camera is told by the one or by the other."""

_USUAL_PIXEL_UM = 5.5

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")

_KEYS: Mapping[str, SpecKey] = {key.path: key for part in spec_sections() for key in part.keys}


@dataclass(frozen=True)
class Draft:
    """A spec as far as it is.

    Attributes
    ----------
    text : str
        The TOML.
    values : dict of str to str
        What the fields show, by key.
    lens : {"field", "focal"}
        Whether the camera is told by its field, or by focal length and pixel.
    products : dict of str to bool
        Which are made.
    bands : tuple of str
        Of the catalog.
    spec : BuildSpec or None
        The spec, where nothing is wrong.
    error : ConfigError or None
        What is wrong.
    """

    text: str
    values: dict[str, str]
    lens: str
    products: dict[str, bool]
    bands: tuple[str, ...]
    spec: BuildSpec | None
    error: ConfigError | None

    @property
    def errors(self) -> dict[str, str]:
        """What is wrong by the field that it is said beside; by `TEXT` where there is none."""
        if self.error is None:
            return {}
        key = self.error.key or ""
        named = [name for name in self.values if name == key]
        inside = [name for name in self.values if key and name.startswith(f"{key}.")]
        words = str(self.error).removeprefix(f"{ORIGIN}: ")
        told = [name for name in inside if name.rpartition(".")[2] in words]
        told.sort(key=lambda name: words.index(name.rpartition(".")[2]))
        return {(named or told or [TEXT])[0]: words}


def draft_of_text(text: str) -> Draft:
    """Return the draft that a text is."""
    text = text.replace("\r\n", "\n")
    try:
        return _checked(content_of_toml(text, ORIGIN), text)
    except ConfigError as error:
        return _draft({}, text, None, ConfigError(str(error), key=TEXT))


def draft_of_form(form: Mapping[str, str]) -> Draft:
    """Return the draft that a form was sent as."""
    text = form.get(TEXT, "").replace("\r\n", "\n")
    before = form.get(BEFORE, "").replace("\r\n", "\n")
    is_edited = text.strip() != before.strip()
    known = draft_of_text(text if is_edited else before)
    if known.error is not None and known.error.key == TEXT:
        return _with_fields_of(form, known)
    if is_edited:
        return known
    content = content_of_toml(before, ORIGIN)
    try:
        _fill(content, form)
        _prune(content)
    except ConfigError as error:
        return _draft(content, before, None, error)
    return known if content == content_of_toml(before, ORIGIN) else draft_of_content(content)


def _with_fields_of(form: Mapping[str, str], draft: Draft) -> Draft:
    """Return a draft whose text cannot be read with the fields as they were."""
    return replace(
        draft,
        values={key: form.get(key, value) for key, value in draft.values.items()},
        lens="focal" if form.get(LENS) == "focal" else "field",
        products={name: f"products.{name}.{ENABLED}" in form for name in PRODUCTS},
        bands=bands_of(form.get("catalog.source", "")),
    )


def draft_of_content(content: Mapping[str, Any]) -> Draft:
    """Return the draft of a spec that is parsed."""
    return _checked(content, plain_toml(content))


def plain_toml(content: Mapping[str, Any]) -> str:
    """Return TOML without comments.

    Examples
    --------
    >>> print(plain_toml({"name": "a", "camera": {"width_px": 64}}), end="")
    name = "a"
    <BLANKLINE>
    [camera]
    width_px = 64
    """
    return "\n".join(_tables(content, ())) if content else ""


def _tables(content: Mapping[str, Any], path: tuple[str, ...]) -> list[str]:
    lines = [f"{_key(k)} = {_inline(v)}\n" for k, v in content.items() if not isinstance(v, dict)]
    parts = []
    if lines or (path and not content):
        head = f"[{'.'.join(map(_key, path))}]\n" if path else ""
        parts.append(head + "".join(lines))
    for name, value in content.items():
        if isinstance(value, dict):
            parts += _tables(value, (*path, name))
    return parts


def _key(name: str) -> str:
    return name if _BARE_KEY.fullmatch(name) else toml_value(name)


def _inline(value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(map(_inline, value))}]"
    if isinstance(value, dict):
        return (
            "{" + ", ".join(f"{_key(name)} = {_inline(one)}" for name, one in value.items()) + "}"
        )
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if _is_huge(value):
        return hex(value)
    return toml_value(value) if isinstance(value, bool | int | float | str) else f"{value}"


def _is_huge(value: Any) -> bool:
    """Return whether a number has more digits than Python writes; none is in any range."""
    return isinstance(value, int) and value.bit_length() > 1000


def without_defaults(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a spec that are not as by default."""
    kept: dict[str, Any] = {}
    for path, key in _KEYS.items():
        value = _at(content, path)
        if value is not None and (key.default is REQUIRED or value != key.default):
            _put(kept, path, value)
    return kept


def _checked(content: Mapping[str, Any], text: str) -> Draft:
    try:
        return _draft(content, text, spec_from_dict(dict(content), ORIGIN), None)
    except ConfigError as error:
        return _draft(content, text, None, error)


def _draft(
    content: Mapping[str, Any], text: str, spec: BuildSpec | None, error: ConfigError | None
) -> Draft:
    has_focal = any(_at(content, key) is not None for key in _OF_LENS["field"])
    enabled = {name: _at(content, f"products.{name}.{ENABLED}") is not False for name in PRODUCTS}
    source = _at(content, "catalog.source")
    return Draft(
        text=text,
        values={key: _shown(key, content) for key in FIELDS},
        lens="focal" if has_focal else "field",
        products=enabled,
        bands=bands_of(source) if isinstance(source, str) else (),
        spec=spec,
        error=error,
    )


def bands_of(source: str) -> tuple[str, ...]:
    """Return the magnitude bands of a catalog; none where there is no such catalog."""
    if source not in source_names():
        return ()
    try:
        return data_source(source).bands
    except StarcatError:
        return ()


def _shown(key: str, content: Mapping[str, Any]) -> str:
    value = _at(content, key)
    if value is None:
        default = _KEYS[key].default
        value = "" if default is REQUIRED or default is None else default
    if key == "selection.bright_limit_mag" and value == _KEYS[key].default:
        return ""  # No star is that bright: there is no limit.
    if _is_huge(value):
        return hex(value)[:40]
    return f"{value:.12g}" if isinstance(value, float) else str(value)


def _fill(content: dict[str, Any], form: Mapping[str, str]) -> None:
    """Put the values of a form's fields into a spec."""
    source = _at(content, "catalog.source")
    for key in FIELDS:
        if key in form and form[key].strip() != _shown(key, content):
            _put(content, key, _typed(key, form[key].strip()))
    if form.get("catalog.source", source) != source:
        bands = bands_of(form["catalog.source"])
        if _at(content, "catalog.band") not in bands:
            _put(content, "catalog.band", bands[0] if bands else None)
    lens = form.get(LENS)
    if lens in _OF_LENS:
        _change_lens(content, lens)
    if "products" in form:
        for name in PRODUCTS:
            is_wanted = f"products.{name}.{ENABLED}" in form
            if is_wanted != (_at(content, f"products.{name}.{ENABLED}") is not False):
                _put(content, f"products.{name}.{ENABLED}", None if is_wanted else False)


def _change_lens(content: dict[str, Any], lens: str) -> None:
    """Tell a camera by its field or by its lens; what is known of it is kept."""
    width, fov, focal, pixel = (
        _number(content, f"camera.{name}")
        for name in ("width_px", "fov_x_deg", "focal_length_mm", "pixel_um")
    )
    if lens == "focal" and width and fov and focal is None:
        pixel = pixel or _USUAL_PIXEL_UM
        tangent = math.tan(math.radians(min(fov, 170.0)) / 2.0)
        _put(content, "camera.pixel_um", pixel)
        _put(content, "camera.focal_length_mm", round(width * pixel / 2000.0 / tangent, 4))
    if lens == "field" and width and focal and pixel and fov is None:
        fov = 2.0 * math.degrees(math.atan(width * pixel / 2000.0 / focal))
        _put(content, "camera.fov_x_deg", round(fov, 4))
    for key in _OF_LENS[lens]:
        _put(content, key, None)


def _number(content: Mapping[str, Any], key: str) -> float | None:
    value = _at(content, key)
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if is_number and value > 0 and math.isfinite(value) else None


def _typed(key: str, text: str) -> Any:
    """Return what was typed as the kind of value that a key has; else the text, to be refused."""
    kind = _KEYS[key].kind
    try:
        if text and kind in ("whole number", "number"):
            return int(text) if kind == "whole number" else float(text)
    except ValueError:
        return text[:200]
    return text or None


def _at(content: Mapping[str, Any], path: str) -> Any:
    value: Any = content
    for name in path.split("."):
        if not isinstance(value, Mapping):
            return None
        value = value.get(name)
    return value


def _put(content: dict[str, Any], path: str, value: Any) -> None:
    if value is None and _at(content, path) is None:
        return
    *tables, name = path.split(".")
    for table in tables:
        content = content.setdefault(table, {})
        if not isinstance(content, dict):
            raise ConfigError(f"{path}: {table} is a value, not a table of the spec", key=TEXT)
    if value is None:
        content.pop(name, None)
    else:
        content[name] = value


def _prune(content: dict[str, Any]) -> None:
    """Remove tables inside others that have become empty; those at the top are needed."""
    for value in content.values():
        if isinstance(value, dict):
            _prune(value)
            for name in [key for key, inner in value.items() if inner == {}]:
                del value[name]
