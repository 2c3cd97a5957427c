"""The keys of a build spec as data, and specs as TOML that explains them.

Unit, range, default, example and meaning come from the spec's own definition, so that printed and
checked values always agree.
"""

from __future__ import annotations

import json
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any

from pydantic import Field

from starcat.pipeline.specs.build_spec import BuildSpec

UNITS = {unit: unit for unit in ("deg", "arcsec", "mag", "px", "mm", "um", "nm")}
UNITS["jyear"] = "Julian year"
"""Unit by the last part of a name; only the unit of proper motions has two parts."""

REQUIRED = object()
"""Marks a key without a default."""


@dataclass(frozen=True)
class SpecKey:
    """One key of a spec."""

    section: tuple[str, ...]  # names of the enclosing tables; empty at the top
    name: str  # the key itself
    kind: str  # ``text``, ``whole number``, ``number``, ``true or false``, ``list`` or ``one of``
    unit: str  # unit of a number, or empty
    range: str  # smallest and largest value, or the choices; empty if all are allowed
    default: Any  # `REQUIRED` if the spec must state the key
    example: Any  # an allowed value; None if the default is a good example
    description: str  # meaning

    @property
    def path(self) -> str:
        """Dotted name, as ``camera.fov_x_deg``."""
        return ".".join((*self.section, self.name))


@dataclass(frozen=True)
class SpecSection:
    """One table of a spec."""

    path: tuple[str, ...]  # names of the enclosing tables and its own name; empty for the top
    description: str  # its topic, in one sentence
    keys: tuple[SpecKey, ...]  # keys in the order of the definition


@cache
def spec_sections() -> tuple[SpecSection, ...]:
    """Return all tables of a spec, a table before those inside it.

    Examples
    --------
    >>> spec_sections()[1].path
    ('catalog',)
    """
    schema = BuildSpec.model_json_schema()
    return tuple(_sections(schema, schema["$defs"], ()))


def unit_of(name: str) -> str:
    """Return the unit that a key's name ends with.

    Examples
    --------
    >>> unit_of("unknown_motion_mas_yr"), unit_of("fov_x_deg"), unit_of("count")
    ('mas/yr', 'deg', '')
    """
    return "mas/yr" if name.endswith("_mas_yr") else UNITS.get(name.rpartition("_")[2], "")


def _sections(
    table: dict[str, Any], definitions: dict[str, Any], path: tuple[str, ...]
) -> Iterator[SpecSection]:
    keys, inner = [], []
    for name, field in table["properties"].items():
        reference = field.get("$ref")
        if reference is not None:
            inner.append((name, definitions[reference.rpartition("/")[2]]))
        else:
            keys.append(_key(path, name, field, is_required=name in table.get("required", ())))
    yield SpecSection(path, table["description"].partition("\n")[0], tuple(keys))
    for name, section in inner:
        yield from _sections(section, definitions, (*path, name))


def _key(path: tuple[str, ...], name: str, field: dict[str, Any], *, is_required: bool) -> SpecKey:
    value = next(
        (option for option in field.get("anyOf", [field]) if option.get("type") != "null"), field
    )
    examples = field.get("examples", [None])
    return SpecKey(
        path,
        name,
        _kind(value),
        unit_of(name),
        _range(value),
        REQUIRED if is_required else field["default"],
        examples[0],
        field["description"],
    )


def _kind(value: dict[str, Any]) -> str:
    kinds = {
        "string": "text",
        "integer": "whole number",
        "number": "number",
        "boolean": "true or false",
        "array": "list",
    }
    return "one of" if "enum" in value else kinds[value["type"]]


def _range(value: dict[str, Any]) -> str:
    choices = value.get("enum") or value.get("items", {}).get("enum")
    if choices:
        return ", ".join(choices)
    if "pattern" in value:
        return f"`{value['pattern']}`"
    low = value.get("minimum", value.get("exclusiveMinimum"))
    high = value.get("maximum", value.get("exclusiveMaximum"))
    if low is None or high is None:
        return f"at most {value['maxLength']:,} characters" if "maxLength" in value else ""
    below = "below " if "exclusiveMaximum" in value else ""
    return f"{_plain(low)} to {below}{_plain(high)}"


def _plain(number: float) -> str:
    return f"{int(number):,}" if number == int(number) else f"{number:g}"


@dataclass(frozen=True)
class CheckedSpec:
    """A spec that can be built."""

    name: Annotated[str, Field(examples=["gaia-12deg"])]
    version: Annotated[str, Field(examples=["1.0.0"])]
    description: Annotated[str, Field(description="Purpose.")]
    sources: Annotated[list[str], Field(description="Catalogs that it reads.", examples=[["gaia"]])]
    spec: Annotated[
        dict[str, Any], Field(description="All keys, with those that are as by default.")
    ]
    toml: Annotated[str, Field(description="The same as a file in which every key is explained.")]

    @classmethod
    def of(cls, spec: BuildSpec) -> CheckedSpec:
        """Return the facts about a spec."""
        content = spec.model_dump(mode="json")
        names = (spec.name, spec.version, spec.description)
        return cls(*names, list(spec.sources), content, spec_toml(spec))


_WIDTH = 96
_NUMBERS_A_LINE = 10


def spec_toml(spec: BuildSpec) -> str:
    """Return a spec as a commented TOML file."""
    content = spec.model_dump(mode="json")
    parts = []
    for section in spec_sections():
        values: dict[str, Any] = content
        for name in section.path:
            values = values[name]
        lines = _comment(section.description)
        if section.path:
            # Write no empty header: appending another text with this header must stay possible.
            is_empty = all(_is_default(key, values[key.name]) for key in section.keys)
            lines.append(f"{'# ' if is_empty else ''}[{'.'.join(section.path)}]")
        plain = [key for key in section.keys if not _is_tables(values[key.name])]
        for key in plain:
            lines += _lines(key, values[key.name])
        parts.append("\n".join(lines))
        # A table ends the keys of the section around it, so lists of tables follow them.
        parts += [_tables(key, values[key.name]) for key in section.keys if key not in plain]
    return "\n\n".join(parts) + "\n"


def toml_value(value: Any) -> str:
    """Return a value as TOML.

    Examples
    --------
    >>> toml_value(["hipparcos"]), toml_value(True), toml_value(6.0)
    ('["hipparcos"]', 'true', '6.0')
    """
    if isinstance(value, list | tuple):
        if len(value) <= _NUMBERS_A_LINE:
            return f"[{', '.join(map(toml_value, value))}]"
        starts = range(0, len(value), _NUMBERS_A_LINE)
        lines = (", ".join(map(toml_value, value[k : k + _NUMBERS_A_LINE])) for k in starts)
        return "[\n  " + ",\n  ".join(lines) + "\n]"
    if isinstance(value, str):
        # TOML supports all escapes of JSON. DEL is not escaped in JSON, but must be in TOML.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return json.dumps(value)


def _lines(key: SpecKey, value: Any) -> list[str]:
    comment = key.description + (f" ({key.range})" if key.kind == "one of" else "")
    if not _is_default(key, value):
        return [*_comment(comment), f"{key.name} = {toml_value(value)}"]
    shown = key.example if value is None else value
    set_to = f"{key.name} = {'...' if shown is None else toml_value(shown)}"
    return [*_comment(comment), f"# {set_to}" + ("" if value is None else "    # the default")]


def _is_tables(value: Any) -> bool:
    return (
        isinstance(value, list) and bool(value) and all(isinstance(entry, dict) for entry in value)
    )


def _tables(key: SpecKey, tables: list[dict[str, Any]]) -> str:
    """Return a key whose value is a list of tables."""
    parts = [
        "\n".join([f"[[{key.path}]]", *(f"{name} = {toml_value(table[name])}" for name in table)])
        for table in tables
    ]
    return "\n".join([*_comment(key.description), "\n\n".join(parts)])


def _is_default(key: SpecKey, value: Any) -> bool:
    return key.default is not REQUIRED and value == key.default


def _comment(text: str) -> list[str]:
    return [f"# {line}" for line in textwrap.wrap(text, _WIDTH)]
