"""Keys of a spec that name a file on the machine of the spec's author.

Such a key is of the type ``Annotated[str, LocalFile(...)]``. A checked spec never contains one:
`with_files_read` replaces the name by the content of the file. Only `read_spec` and `local_preset`
call it, for specs that the user of this machine has written. Everywhere else, for example in a
request to the service, the check of the spec refuses the key, and no file is opened.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel, GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import core_schema

MAX_NAME_CHARACTERS = 1000


@dataclass(frozen=True)
class LocalFile:
    """Marks the type of a key that names a file."""

    instead: str  # keys that state the content of the file in the spec itself
    # Reads the file, given the other keys of the section; returns the keys that state its content.
    read: Callable[[Path, Mapping[str, Any]], dict[str, Any]]

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> core_schema.CoreSchema:
        """Return a check that refuses every value."""
        text = core_schema.str_schema(max_length=MAX_NAME_CHARACTERS)
        return core_schema.no_info_before_validator_function(self._refuse, text)

    def __get_pydantic_json_schema__(
        self, schema: core_schema.CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Return the JSON Schema of the key: a text."""
        return {"type": "string", "maxLength": MAX_NAME_CHARACTERS}

    def _refuse(self, value: object) -> str:
        raise ValueError(
            f"this key names a file, and no file is read here; state {self.instead} in its place. "
            "Only a spec that is a file on your machine may name another file there"
        )


def keys_of_files(model: type[BaseModel]) -> tuple[str, ...]:
    """Return the dotted keys of a model that name files.

    Examples
    --------
    >>> from starcat.pipeline.specs.build_spec import BuildSpec
    >>> keys_of_files(BuildSpec)
    ('selection.region.moc_file', 'camera.response.file', 'camera.response.optics_file')
    """
    return tuple(".".join(path) for path, _ in _local_files(model, ()))


def with_files_read(
    model: type[BaseModel], content: dict[str, Any], folder: Path
) -> dict[str, Any]:
    """Return a spec's content with its files' content; their names are relative to a folder."""
    for (*above, name), local in _local_files(model, ()):
        section: Any = content
        for key in above:
            section = section.get(key) if isinstance(section, dict) else None
        if not isinstance(section, dict) or not isinstance(section.get(name), str):
            continue
        others = {key: value for key, value in section.items() if key != name}
        read = {**others, **local.read(folder / section[name], others)}
        for depth in range(len(above), 0, -1):
            outer: Any = content
            for key in above[: depth - 1]:
                outer = outer[key]
            read = {**outer, above[depth - 1]: read}
        content = read
    return content


def _local_files(
    model: type[BaseModel], above: tuple[str, ...]
) -> Iterator[tuple[tuple[str, ...], LocalFile]]:
    for name, field in model.model_fields.items():
        parts = list(_parts(field.annotation))
        for part in (*field.metadata, *parts):
            if isinstance(part, LocalFile):
                yield (*above, name), part
        for part in parts:
            if isinstance(part, type) and issubclass(part, BaseModel):
                yield from _local_files(part, (*above, name))


def _parts(annotation: Any) -> Iterator[Any]:
    """Yield a type, the types inside it, and their annotations."""
    yield annotation
    for part in get_args(annotation):
        yield from _parts(part)
