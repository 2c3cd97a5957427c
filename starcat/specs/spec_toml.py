"""Specs as TOML that explains itself: every key with its meaning, defaults as comments."""

from __future__ import annotations

import json
import textwrap
from typing import Any

from starcat.specs.build_spec import BuildSpec
from starcat.specs.keys import REQUIRED, SpecKey, spec_sections

_WIDTH = 96


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
            lines.append(f"[{'.'.join(section.path)}]")
        for key in section.keys:
            lines += _lines(key, values[key.name])
        parts.append("\n".join(lines))
    return "\n\n".join(parts) + "\n"


def toml_value(value: Any) -> str:
    """Return a value as TOML writes it.

    Examples
    --------
    >>> toml_value(["hipparcos"]), toml_value(True), toml_value(6.0)
    ('["hipparcos"]', 'true', '6.0')
    """
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml_value, value))}]"
    if isinstance(value, str):
        # JSON's escapes are among TOML's; the one control character that JSON lets pass is not.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return json.dumps(value)


def _lines(key: SpecKey, value: Any) -> list[str]:
    told = key.description + (f" ({key.range})" if key.kind == "one of" else "")
    is_default = key.default is not REQUIRED and value == key.default
    if not is_default:
        return [*_comment(told), f"{key.name} = {toml_value(value)}"]
    shown = key.example if value is None else value
    set_to = f"{key.name} = {'...' if shown is None else toml_value(shown)}"
    return [*_comment(told), f"# {set_to}" + ("" if value is None else "    # the default")]


def _comment(text: str) -> list[str]:
    return [f"# {line}" for line in textwrap.wrap(text, _WIDTH)]
