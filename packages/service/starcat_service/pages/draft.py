"""A spec on its way: the fields of a form and the text of a TOML file as two views of one thing.

The text is what counts. A form that comes back with the text as it was given changes the keys that
it has fields for and leaves all others; with a text that was edited, the fields follow the text.
"""

from __future__ import annotations

import copy
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import tomlkit
from pydantic import ValidationError
from tomlkit.exceptions import TOMLKitError

from starcat.catalog import data_source, source_names
from starcat.database.products import USUAL_PRODUCTS
from starcat.errors import ConfigError, StarcatError
from starcat.pipeline.selection import form_fields
from starcat.pipeline.specs import (
    REQUIRED,
    BuildSpec,
    SpecKey,
    put_key,
    spec_from_dict,
    spec_sections,
    value_at,
    with_own_description,
)
from starcat.storage import all_that_is_wrong, content_of_toml
from starcat_service.pages.response import FILE, NAME, keys_of_another, responses_of

ORIGIN = "spec"  # what messages call the text
TEXT = "toml"
BEFORE = "toml-before"
LENS = "lens"
ENABLED = "enabled"

FORM_PRODUCTS = (*USUAL_PRODUCTS, "levels")
"""Products that the form has a box for: ``levels`` is for databases of many fields of view."""

WIDEST = "products.levels.widest_fov_x_deg"

RULE_FIELDS = form_fields()
"""How the form shows the keys of rules of selection, by key; the rules say it themselves."""

FIELDS = (
    "name",
    "version",
    "description",
    "epoch_jyear",
    "catalog.source",
    "catalog.band",
    "camera.width_px",
    "camera.height_px",
    "camera.fov_x_deg",
    "camera.focal_length_mm",
    "camera.pixel_um",
    "boresights.count",
    "boresights.brightest",
    WIDEST,
    "camera.response.name",
    *RULE_FIELDS,
)
"""Keys that the form has a field for, by the same names."""

_OF_LENS = {"field": ("camera.focal_length_mm", "camera.pixel_um"), "focal": ("camera.fov_x_deg",)}
"""What goes away where a camera is told by the one or by the other."""

_USUAL_PIXEL_UM = 5.5

_SPAN = re.compile(
    r"\[?\s*([0-9]{1,6}(?:\.[0-9]*)?)\s*(?:-|–|,|to)\s*([0-9]{1,6}(?:\.[0-9]*)?)\s*\]?"
)
"""The years of a mission: 2027-2042."""

_KEYS: Mapping[str, SpecKey] = {key.path: key for part in spec_sections() for key in part.keys}


@dataclass(frozen=True)
class SpecForm:
    """A spec as far as it is."""

    text: str  # TOML
    values: dict[str, str]  # what the fields show, by key
    lens: str  # "field" or "focal": the camera is told by its field, or by its lens
    products: dict[str, bool]  # which are made
    bands: tuple[str, ...]  # of the catalog
    responses: list[tuple[str, str]]  # of the sensor: name, text
    content: Mapping[str, Any]  # what the text says; nothing where it cannot be read
    spec: BuildSpec | None  # None: something is wrong
    wrong: tuple[ConfigError, ...] = ()

    def uses_rule(self, group: str, *kinds: str) -> bool:
        """Return whether a rule is used whose field has a group and one of some kinds."""
        for key, shown in RULE_FIELDS.items():
            usual = shown.choices[0][0] if shown.choices else ""
            if shown.group == group and shown.kind in kinds and self.values[key] not in ("", usual):
                return True
        return False

    @property
    def error(self) -> ConfigError | None:
        """The first of what is wrong."""
        return self.wrong[0] if self.wrong else None

    @property
    def errors(self) -> dict[str, str]:
        """What is wrong by the field that it is said beside; by `TEXT` where there is none."""
        messages: dict[str, str] = {}
        for error in self.wrong:
            for key, words in self._beside(error).items():
                messages.setdefault(key, words)
        return messages

    def field_of(self, key: str | None) -> str | None:
        """Return the field of a key, or the first field of a section; None if there is none."""
        if not key:
            return None
        return next((name for name in self.values if f"{name}.".startswith(f"{key}.")), None)

    def _beside(self, error: ConfigError) -> dict[str, str]:
        key = re.sub(r"(\.|\[)\d+\]?$", "", error.key or "")  # of a list: that of its item
        named = [name for name in (*self.values, FILE) if name == key]
        inside = [name for name in self.values if key and name.startswith(f"{key}.")]
        words = str(error).removeprefix(f"{ORIGIN}: ")
        mentioned = [name for name in inside if name.rpartition(".")[2] in words]
        mentioned.sort(key=lambda name: words.index(name.rpartition(".")[2]))
        return {(named or mentioned or [TEXT])[0]: words}


def draft_of_text(text: str) -> SpecForm:
    """Return the draft that a text is."""
    text = text.replace("\r\n", "\n")
    try:
        return _draft(content_of_toml(text, ORIGIN), text)
    except ConfigError as error:
        return _draft({}, text, ConfigError(str(error), key=TEXT))


def draft_of_form(form: Mapping[str, str]) -> SpecForm:
    """Return the draft that a form was sent as."""
    text = form.get(TEXT, "").replace("\r\n", "\n")
    before = form.get(BEFORE, "").replace("\r\n", "\n")
    is_edited = text.strip() != before.strip()
    draft = draft_of_text(text if is_edited else before)
    if draft.error is not None and draft.error.key == TEXT:
        return _with_fields_of(form, draft)
    if is_edited:
        return _with_own_description(draft)
    content = content_of_toml(before, ORIGIN)
    try:
        edit = _edit(content, form)
    except ConfigError as error:
        return _draft(content, before, ConfigError(str(error), key=TEXT))
    return _edited(draft, edit)


def draft_with(draft: SpecForm, changes: Mapping[str, Any]) -> SpecForm:
    """Return a draft with other values of some keys; None removes one."""
    edit = _Edit(copy.deepcopy(dict(draft.content)))
    for path, value in changes.items():
        if value != value_at(edit.content, path):
            edit.put(path, value)
    return _edited(draft, edit)


def _edited(draft: SpecForm, edit: _Edit) -> SpecForm:
    """Return a draft with the changes of an edit."""
    if not edit.changes:
        return draft
    edited = _draft(edit.content, edit.text(draft.text))
    return edited if "description" in edit.changes else _with_own_description(edited)


def _with_own_description(draft: SpecForm) -> SpecForm:
    """Return a draft whose description is made from its spec, unless its user wrote one."""
    if draft.spec is None:
        return draft
    words = with_own_description(draft.spec).description
    return draft if words == draft.spec.description else draft_with(draft, {"description": words})


def _with_fields_of(form: Mapping[str, str], draft: SpecForm) -> SpecForm:
    """Return a draft whose text cannot be read with the fields as they were."""
    values = {key: form.get(key, value) for key, value in draft.values.items()}
    return replace(
        draft,
        values=values,
        lens="focal" if form.get(LENS) == "focal" else "field",
        products={name: f"products.{name}.{ENABLED}" in form for name in FORM_PRODUCTS},
        bands=bands_of(form.get("catalog.source", "")),
        responses=responses_of(values[NAME]),
    )


def draft_of_content(content: Mapping[str, Any]) -> SpecForm:
    """Return the draft of a spec that is parsed."""
    return _draft(content, tomlkit.dumps(content))


def without_defaults(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a spec that are not as by default."""
    kept: dict[str, Any] = {}
    for path, key in _KEYS.items():
        value = value_at(content, path)
        if value is not None and (key.default is REQUIRED or value != key.default):
            put_key(kept, path, value)
    return kept


def _draft(content: Mapping[str, Any], text: str, error: ConfigError | None = None) -> SpecForm:
    spec = None
    wrong: tuple[ConfigError, ...] = () if error is None else (error,)
    if error is None:
        try:
            spec = spec_from_dict(dict(content), ORIGIN)
        except ConfigError as refusal:
            wrong = (refusal,)
            if isinstance(refusal.__cause__, ValidationError):
                wrong = tuple(all_that_is_wrong(refusal.__cause__, ORIGIN, BuildSpec, "spec"))
    has_focal = any(value_at(content, key) is not None for key in _OF_LENS["field"])
    source = value_at(content, "catalog.source")
    values = {key: _shown(key, content) for key in FIELDS}
    return SpecForm(
        text=text,
        values=values,
        lens="focal" if has_focal else "field",
        products={name: _is_made(content, name) for name in FORM_PRODUCTS},
        bands=bands_of(source) if isinstance(source, str) else (),
        responses=responses_of(values[NAME]),
        content=content,
        spec=spec,
        wrong=wrong,
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
    value = value_at(content, key)
    if value is None:
        default = _KEYS[key].default
        value = "" if default is REQUIRED or default is None else default
    if key == "selection.bright_limit_mag" and value == _KEYS[key].default:
        return ""  # No star is that bright: there is no limit.
    if key == "epoch_jyear" and isinstance(value, list) and len(value) == 2:
        value = "-".join(map(_number_text, value))
    if _KEYS[key].kind == "list" and isinstance(value, list):
        return ", ".join(map(_number_text, value))
    if isinstance(value, int) and value.bit_length() > 1000:  # more digits than Python writes
        return hex(value)[:40]
    return _number_text(value)


def _number_text(value: Any) -> str:
    return f"{value:.12g}" if isinstance(value, float) else str(value)


class _Edit:
    """Changes of the content of a text."""

    def __init__(self, content: dict[str, Any]) -> None:
        self.content = content
        self.changes: dict[str, Any] = {}

    def put(self, path: str, value: Any) -> None:
        """Change a key; None removes it."""
        if value is not None or value_at(self.content, path) is not None:
            put_key(self.content, path, value)
            self.changes[path] = value

    def text(self, before: str) -> str:
        """Return the text with the changes, its comments and its order."""
        try:
            document = tomlkit.parse(before)
            for path, value in self.changes.items():
                put_key(document, path, value)
            text = _with_empty_lines(tomlkit.dumps(document), before)
            if content_of_toml(text, ORIGIN) == self.content:
                return text
        except (TOMLKitError, ConfigError, ValueError, TypeError, LookupError, RecursionError):
            pass  # a text whose order cannot be kept, as some with dotted keys
        return tomlkit.dumps(self.content)


_HEAD = re.compile(r"(?<=[^\n]\n)(?=(\[+[\w.\"' -]+\]+)[ \t]*(?:#.*)?$)", re.MULTILINE)


def _with_empty_lines(text: str, before: str) -> str:
    """Return a text with an empty line before each table, unless it stood without one.

    tomlkit puts a key that is new in a table behind the empty line at the end of the table.
    """
    close = {head[1] for head in _HEAD.finditer(before)}
    starts = [head.start() for head in _HEAD.finditer(text) if head[1] not in close]
    for start in reversed(starts):
        line = text[text.rfind("\n", 0, start - 1) + 1 : start]
        if not line.startswith("#"):
            text = f"{text[:start]}\n{text[start:]}"
    return text


def _edit(content: dict[str, Any], form: Mapping[str, str]) -> _Edit:
    edit = _Edit(content)
    source = value_at(content, "catalog.source")
    for key in FIELDS:
        if key in form and form[key].strip() != _shown(key, content):
            edit.put(key, _typed(key, form[key].strip()))
    if form.get("catalog.source", source) != source:
        bands = bands_of(form["catalog.source"])
        if value_at(content, "catalog.band") not in bands:
            edit.put("catalog.band", bands[0] if bands else None)
    if NAME in edit.changes:
        for key in keys_of_another(content, form[NAME].strip()):
            edit.put(key, None)
    lens = form.get(LENS)
    if lens in _OF_LENS:
        _change_lens(edit, lens)
    if "products" in form:
        for name in FORM_PRODUCTS:
            key = f"products.{name}.{ENABLED}"
            is_wanted = key in form
            if is_wanted != _is_made(content, name):
                edit.put(key, None if is_wanted == _KEYS[key].default else is_wanted)
    return edit


def _is_made(content: Mapping[str, Any], name: str) -> bool:
    key = f"products.{name}.{ENABLED}"
    value = value_at(content, key)
    return bool(_KEYS[key].default) if value is None else value is not False


def _change_lens(edit: _Edit, lens: str) -> None:
    """Tell a camera by its field or by its lens; what is known of it is kept."""
    width, fov, focal, pixel = (
        _number(edit.content, f"camera.{name}")
        for name in ("width_px", "fov_x_deg", "focal_length_mm", "pixel_um")
    )
    if lens == "focal" and width and fov and focal is None:
        pixel = pixel or _USUAL_PIXEL_UM
        tangent = math.tan(math.radians(min(fov, 170.0)) / 2.0)
        edit.put("camera.pixel_um", pixel)
        edit.put("camera.focal_length_mm", round(width * pixel / 2000.0 / tangent, 4))
    if lens == "field" and width and focal and pixel and fov is None:
        fov = 2.0 * math.degrees(math.atan(width * pixel / 2000.0 / focal))
        edit.put("camera.fov_x_deg", round(fov, 4))
    for key in _OF_LENS[lens]:
        edit.put(key, None)


def _number(content: Mapping[str, Any], key: str) -> float | None:
    value = value_at(content, key)
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if is_number and value > 0 and math.isfinite(value) else None


def _typed(key: str, text: str) -> Any:
    """Return what was typed as the kind of value that a key has; else the text, to be refused."""
    if key == "epoch_jyear" and (span := _SPAN.fullmatch(text)):
        return [float(span[1]), float(span[2])]
    kind = _KEYS[key].kind
    try:
        if text and kind in ("whole number", "number"):
            return int(text) if kind == "whole number" else float(text)
        if text and kind == "list":
            return [float(part) for part in text.strip("[] ").split(",")]
    except ValueError:
        return text[:200]
    return text or None
