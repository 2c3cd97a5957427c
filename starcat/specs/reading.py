"""Specs as files and presets: read, change and check them, and describe errors."""

from __future__ import annotations

import codecs
import tomllib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, get_args, get_origin

from pydantic import BaseModel, ValidationError

from starcat.arguments import path_of
from starcat.errors import ConfigError, FileMissing, SourceError, quoted, suggest
from starcat.failures import expected_words
from starcat.local_files import with_files_read
from starcat.resources import PathLike, resource_folder
from starcat.specs.build_spec import BuildSpec
from starcat.specs.description import own_description
from starcat.specs.shown import toml_shown
from starcat.storage.regular_files import read_regular_file

MAX_CHARACTERS, MAX_POINTS = 100_000, 200
"""Most characters in the text of a spec, and most full stops in a line."""

MAX_BYTES = 4 * MAX_CHARACTERS
"""Largest size of the file of a spec or of a camera."""

Changes = Mapping[str, str]
"""Values by dotted key, as texts: ``{"camera.fov_x_deg": "16"}``."""


def read_spec(path: PathLike, changes: Changes | None = None) -> BuildSpec:
    """Read a build spec from a TOML file.

    Parameters
    ----------
    path : str or path-like
        The file.
    changes : mapping of str to str, optional
        Values by dotted key that replace the file's values, as TOML. A text that is not a TOML
        value is used as a text; an empty text removes the key.

    Returns
    -------
    BuildSpec
        The checked spec.

    Raises
    ------
    ConfigError
        If the file is missing or not TOML, or a key is unknown, missing or out of range.
    """
    path = path_of("path", path, "the path of a spec")
    text = text_of_toml(path, "no such spec; 'starcat presets' lists those that ship with starcat")
    content = changed(content_of_toml(text, str(path)), changes or {})
    return spec_from_dict(with_files_read(BuildSpec, content, path.parent), path.name)


def text_of_toml(path: Path, missing: str) -> str:
    """Read a TOML file; ``missing`` is the error message if the file does not exist."""
    try:
        content = read_regular_file(path, MAX_BYTES)
    except FileMissing:
        raise FileMissing(f"{path}: {missing}") from None
    except SourceError as error:
        raise ConfigError(f"{error}; expected a TOML file") from error
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        where = f"line {line} has the byte 0x{content[error.start]:02x}"
        if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
            where = "it is in UTF-16"
        raise ConfigError(
            f"{path}: is not in UTF-8, the encoding of TOML: {where}; save it again as UTF-8"
        ) from error


def content_of_toml(text: str, origin: str) -> dict[str, Any]:
    """Read the text of a spec or of a camera.

    A byte order mark, with which some editors of Windows begin a text, is left out.

    The parser's time grows with the square of the number of parts in a dotted key: 40 kB of them
    take 8 s. Such lines are refused before parsing.
    """
    if len(text) > MAX_CHARACTERS:
        raise ConfigError(
            f"{origin}: {len(text):,} characters; at most {MAX_CHARACTERS:,} are read, and a spec "
            "with every key explained has 12,000. Leave out what is no spec"
        )
    for number, line in enumerate(text.split("\n"), start=1):
        if line.count(".") > MAX_POINTS:
            raise ConfigError(
                f"{origin}: line {number} has {line.count('.'):,} full stops; at most "
                f"{MAX_POINTS} are read, and a key of a spec has two"
            )
    try:
        content = tomllib.loads(text.removeprefix("\ufeff"))
    except (ValueError, RecursionError) as error:
        why = "nested too deep" if isinstance(error, RecursionError) else error
        raise ConfigError(f"{origin}: not a readable TOML file: {why}") from error
    _check_integers(content, origin)
    return content


def _check_integers(content: dict[str, Any], origin: str) -> None:
    """Refuse integers beyond TOML's range: Python cannot print an integer of 4,300 digits."""
    left: list[tuple[str, Any]] = list(content.items())
    while left:
        key, value = left.pop()
        if isinstance(value, dict):
            left += [(f"{key}.{name}", one) for name, one in value.items()]
        elif isinstance(value, list):
            left += [(key, one) for one in value]
        elif isinstance(value, int) and not -(2**63) <= value < 2**63:
            shown = _shown_key(key)
            raise ConfigError(
                f"{origin}: {shown}: found {toml_shown(value)}; an integer of TOML is from -2^63 "
                "to 2^63 - 1",
                key=shown,
            )


def changed(content: dict[str, Any], changes: Changes) -> dict[str, Any]:
    """Change the content of a spec, key by key."""
    for key, text in changes.items():
        put_key(content, key, _value(text) if text else None)
    return content


def put_key(content: dict[str, Any], key: str, value: Any) -> None:
    """Change a dotted key; None removes the key, and each nested table that becomes empty."""
    *tables, name = key.split(".")
    around = []
    for table in tables:
        if table not in content:
            content[table] = {}
        around.append((content, table))
        content = content[table]
        if not isinstance(content, dict):
            raise ConfigError(f"{key}: {table} is a value, not a table of the spec", key=key)
    if value is not None:
        content[name] = value
        return
    content.pop(name, None)
    for outer, table in reversed(around[1:]):
        if not outer[table]:
            del outer[table]


def value_at(content: Mapping[str, Any], key: str) -> Any:
    """Return the value of a dotted key, or None if the content lacks it."""
    value: Any = content
    for name in key.split("."):
        if not isinstance(value, Mapping):
            return None
        value = value.get(name)
    return value


def _value(text: str) -> Any:
    try:
        return content_of_toml(f"value = {text}", "")["value"]
    except ConfigError:
        return text


def spec_from_dict(content: dict[str, Any], origin: str) -> BuildSpec:
    """Check a spec that is already parsed."""
    try:
        return BuildSpec.model_validate(content)
    except ValidationError as error:
        raise what_is_wrong(error, origin) from error


def what_is_wrong(
    error: ValidationError, origin: str, model: type[BaseModel] = BuildSpec, kind: str = "spec"
) -> ConfigError:
    """Return the error for the first wrong key; misspelt keys come before missing ones."""
    return all_that_is_wrong(error, origin, model, kind)[0]


def all_that_is_wrong(
    error: ValidationError, origin: str, model: type[BaseModel] = BuildSpec, kind: str = "spec"
) -> list[ConfigError]:
    """Return an error for each wrong key, in the order of `what_is_wrong`."""
    found = []
    for entry in sorted(error.errors(), key=lambda entry: entry["type"] != "extra_forbidden"):
        key = ".".join(_shown_key(str(part)) for part in entry["loc"]) or kind
        text = _explain(dict(entry), model, kind)
        found.append(ConfigError(f"{origin}: {key}: {text}", key=key, value=entry["input"]))
    return found


def _shown_key(name: str) -> str:
    return name if name.isprintable() and len(name) <= 60 else quoted(name)


def _explain(error: dict[str, Any], model: type[BaseModel], kind_of_file: str) -> str:
    kind, context, location = error["type"], error.get("ctx", {}), error["loc"]
    if kind == "extra_forbidden":
        around = _model_at(location[:-1], model)
        advice = getattr(around, "not_keys", {}).get(location[-1])
        if advice is not None:
            return str(advice)
        known = sorted(getattr(around, "model_fields", ()))
        hint = suggest(str(location[-1])[:100], known)
        return f"unknown key; {hint}known keys here: {', '.join(known)}"
    if kind == "missing" and not isinstance(location[-1], int):
        return f"missing; every {kind_of_file} needs it"
    if kind == "value_error":
        return str(context.get("error", error["msg"]))
    value = error["input"]
    found = toml_shown(value)
    expected = expected_words(error)
    if kind in ("missing", "too_long", "too_short") and isinstance(value, list | tuple):
        fixed = _list_at(location, model)
        return f"found a list of {len(value):,}; " + (f"expected {fixed}" if fixed else expected)
    if kind == "less_than" and str(location[-1]).startswith("fov_"):
        expected += ": specs are for a flat detector; give the part of a wider field that is used"
    if kind == "tuple_type":
        name = ".".join(map(str, location))
        if isinstance(value, dict) and hasattr(_model_at(location, model), "model_fields"):
            expected = f"expected an array of tables; write [[{name}]], with double brackets"
        elif isinstance(value, str):
            expected += f"; write {location[-1]} = [{toml_shown(value)}]"
    if kind == "model_type" and isinstance(value, list) and not isinstance(location[-1], int):
        expected += f"; write [{'.'.join(map(str, location))}], with single brackets"
    return f"found {found if len(found) < 60 else found[:57] + '...'}; {expected}"


def _annotation_at(location: tuple[Any, ...], model: Any) -> Any:
    """Return the type of a key: of its value, or of the items of a list."""
    kind = model
    for part in location:
        fields = getattr(_section_in(kind), "model_fields", {})
        kind = fields[part].annotation if part in fields else kind
    return kind


def _section_in(kind: Any) -> Any:
    """Return the section that a type is or holds; the type itself if there is none."""
    return next((one for one in (kind, *get_args(kind)) if hasattr(one, "model_fields")), kind)


def _model_at(location: tuple[Any, ...], model: Any) -> Any:
    return _section_in(_annotation_at(location, model))


def _list_at(location: tuple[Any, ...], model: Any) -> str | None:
    """Return the expected list in words, if a key has a list of fixed length; else None."""
    keys = tuple(part for part in location if not isinstance(part, int))
    kind = _annotation_at(keys, model)
    for one in (kind, *get_args(kind)):
        items = get_args(one)
        if get_origin(one) is tuple and Ellipsis not in items:
            field = _model_at(keys[:-1], model).model_fields[keys[-1]]
            return f"a list of {len(items)}: {field.description}"
    return None


def preset_names() -> tuple[str, ...]:
    """Return the names of the presets that ship with starcat, the default first.

    Examples
    --------
    >>> preset_names()[0]
    'gaia-12deg'
    """
    names = sorted(path.stem for path in resource_folder("specs/presets").glob("*.toml"))
    return tuple(sorted(names, key=lambda name: (name != "gaia-12deg", name)))


def preset(name: str, changes: Changes | None = None) -> BuildSpec:
    """Return a preset. If the changes name a file, it is refused and not read.

    Parameters
    ----------
    name : str
        A name that ``starcat presets`` lists.
    changes : mapping of str to str, optional
        As for `read_spec`.

    Returns
    -------
    BuildSpec
        The checked spec.

    Raises
    ------
    ConfigError
        If there is no such preset, or a change has an invalid value, or names a file.
    """
    return with_own_description(
        spec_from_dict(changed(_preset_content(name), changes or {}), f"{name}.toml")
    )


def with_own_description(spec: BuildSpec) -> BuildSpec:
    """Return a spec whose description is made from it, unless its user wrote one."""
    words = own_description(spec, _presets())
    return spec if words == spec.description else spec.model_copy(update={"description": words})


@cache
def _presets() -> tuple[BuildSpec, ...]:
    return tuple(spec_from_dict(_preset_content(name), f"{name}.toml") for name in preset_names())


def local_preset(name: str, changes: Changes | None = None) -> BuildSpec:
    """Return a preset like `preset`, but read the files that the changes name.

    Relative names start at the current folder. It is only for the user of this machine: the
    service must never call it.
    """
    content = with_files_read(BuildSpec, changed(_preset_content(name), changes or {}), Path())
    return with_own_description(spec_from_dict(content, f"{name}.toml"))


def _preset_content(name: str) -> dict[str, Any]:
    if name not in preset_names():
        hint = suggest(str(name), preset_names())
        raise ConfigError(
            f"unknown preset {quoted(str(name))}",
            key="preset",
            value=name,
            hint=f"{hint}known presets: {', '.join(preset_names())}",
        )
    path = resource_folder("specs/presets") / f"{name}.toml"
    return content_of_toml(text_of_toml(path, "no such preset"), path.name)
