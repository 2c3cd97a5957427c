"""A design as an address: a preset, and the keys of the spec that differ from it.

``?preset=sao-12deg&camera.fov_x_deg=20`` can be read, written by hand and sent to a colleague. A
text with comments, or a text that is not TOML, is put into the address unchanged: nothing is lost.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import Any
from urllib.parse import parse_qsl, urlencode

import tomlkit

from starcat.errors import ConfigError
from starcat.pipeline.specs import (
    changed,
    preset,
    preset_names,
    spec_from_dict,
    with_own_description,
)
from starcat_service.pages.draft import (
    TEXT,
    SpecForm,
    draft_of_content,
    draft_of_text,
    without_defaults,
)

PRESET, PINNED = "preset", "pinned"
OTHERS = (PRESET, PINNED, TEXT, "job", "database")
"""Parts of an address besides keys of a spec."""

DESCRIPTION = "description"
"""A key that follows the others as long as the user does not write it."""

MAX_CHARACTERS = 12_000
"""Most characters of an address: some servers refuse longer ones."""


def design_query(draft: SpecForm, preset_name: str, pinned: str = "") -> str | None:
    """Return the query of the address of a design: empty, or with its question mark.

    None if it is too long for an address, for example with a large table of a response.
    """
    base = preset_name if preset_name in preset_names() else preset_names()[0]
    query = {PRESET: base} if base != preset_names()[0] else {}
    changes = _changes(draft, base)
    query |= {TEXT: draft.text} if changes is None else changes
    if pinned:
        query[PINNED] = pinned
    text = urlencode(query, safe="/:, ").replace(" ", "+")
    if len(text) > MAX_CHARACTERS:
        return None
    return f"?{text}" if text else ""


def draft_of_query(query: Mapping[str, str]) -> SpecForm:
    """Return the design of an address."""
    if TEXT in query:
        return draft_of_text(query[TEXT])
    changes = {key: text for key, text in query.items() if key not in OTHERS}
    base = _base(query.get(PRESET) or preset_names()[0])
    try:
        return draft_of_content(_changed(base, changes))
    except (ConfigError, ValueError, TypeError) as error:
        raise ConfigError(f"the address is of no design: {error}", key="address") from None


def _changed(content: dict[str, Any], changes: Mapping[str, str]) -> dict[str, Any]:
    """Return changed content; its description follows unless it is changed too."""
    content = changed(content, changes)
    if changes and DESCRIPTION not in changes:
        with suppress(ConfigError):  # of a spec that is not valid yet
            words = with_own_description(spec_from_dict(content, "the design")).description
            if words != content.get(DESCRIPTION, ""):
                content[DESCRIPTION] = words
    return content


def pinned_draft(query: str) -> SpecForm:
    """Return the design that is pinned, from the query of its address."""
    return draft_of_query(dict(parse_qsl(query.removeprefix("?"), keep_blank_values=True)))


def _base(name: str) -> dict[str, Any]:
    return without_defaults(preset(name).recorded())


def _changes(draft: SpecForm, base: str) -> dict[str, str] | None:
    """Return the differences from a preset by key; None if they would lose some of the text."""
    before, after = dict(_leaves(_base(base))), dict(_leaves(draft.content))
    if "#" in draft.text or not draft.content:
        return None
    changes = {key: _typed(value) for key, value in after.items() if before.get(key) != value}
    changes |= {key: "" for key in before if key not in after}
    if any(key in OTHERS for key in changes):
        return None
    try:
        shorter = {key: text for key, text in changes.items() if key != DESCRIPTION}
        if _changed(_base(base), shorter) == draft.content:
            return shorter
        same = _changed(_base(base), changes)
    except (ConfigError, ValueError, TypeError):
        return None
    return changes if same == draft.content else None


def _leaves(content: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in content.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{above}{name}.")
        else:
            yield f"{above}{name}", value


def _typed(value: Any) -> str:
    """Return a value as `changed` reads it: text has no quotes unless they are necessary."""
    if isinstance(value, str) and value and changed({}, {"x": value}) == {"x": value}:
        return value
    return str(tomlkit.item(value).as_string())


def differences(now: SpecForm, pinned: SpecForm) -> list[tuple[str, str, str]]:
    """Return key, value and pinned value of each difference between two designs."""
    mine, others = dict(_leaves(now.content)), dict(_leaves(pinned.content))
    keys = [*mine, *(key for key in others if key not in mine)]
    return [
        (key, _shown(mine, key), _shown(others, key))
        for key in keys
        if mine.get(key) != others.get(key) and key not in ("name", "description", "version")
    ]


def _shown(content: Mapping[str, Any], key: str) -> str:
    return _typed(content[key]) if key in content else "as by default"
