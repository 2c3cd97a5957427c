"""Specs as files and presets: read, change and check them."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from starcat.arguments import path_of
from starcat.database.manifest import MANIFEST_NAME
from starcat.database.reader import DatabaseFolder
from starcat.errors import ConfigError, quoted, suggest
from starcat.local_files import with_files_read
from starcat.pipeline.specs.build_spec import BuildSpec
from starcat.pipeline.specs.description import own_description
from starcat.resources import PathLike, resource_folder
from starcat.storage.toml_files import content_of_toml, text_of_toml, what_is_wrong

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
            raise ConfigError(f"{table} is a value, not a table of the spec", where=key, key=key)
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
        raise what_is_wrong(error, origin, BuildSpec, "spec") from error


def spec_of_database(database: DatabaseFolder) -> BuildSpec:
    """Return the spec that a database was built from."""
    return spec_from_dict(database.manifest["spec"], f"{database.folder.name}/{MANIFEST_NAME}")


def preset_names() -> tuple[str, ...]:
    """Return the names of the presets that ship with starcat, the default first.

    Examples
    --------
    >>> preset_names()[0]
    'gaia-12deg'
    """
    names = sorted(path.stem for path in resource_folder("pipeline/specs/presets").glob("*.toml"))
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
    path = resource_folder("pipeline/specs/presets") / f"{name}.toml"
    return content_of_toml(text_of_toml(path, "no such preset"), path.name)
