"""Keys of a spec that name a file on the machine of whoever writes the spec.

Such a key is of the type ``Annotated[str, LocalFile(...)]``. A spec that is checked never holds a
value of it: `with_files_read` replaces the name by the content of the file, and only the functions
that read a spec from a file of this machine call it. Everywhere else, as in a request to the
service, the check of the spec refuses the key, and no file is opened.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, get_args

from pydantic import BaseModel, GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import core_schema

MAX_NAME_CHARACTERS = 1000


@dataclass(frozen=True)
class LocalFile:
    """Marks the type of a key that names a file."""

    instead: str  # the keys that state the content of the file in the spec itself

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
    >>> from starcat.specs.build_spec import BuildSpec
    >>> keys_of_files(BuildSpec)
    ('camera.response.file', 'camera.response.optics_file')
    """
    return tuple(_keys(model, ()))


def _keys(model: type[BaseModel], above: tuple[str, ...]) -> Iterator[str]:
    for name, field in model.model_fields.items():
        parts = list(_parts(field.annotation))
        if any(isinstance(part, LocalFile) for part in (*field.metadata, *parts)):
            yield ".".join((*above, name))
        for part in parts:
            if isinstance(part, type) and issubclass(part, BaseModel):
                yield from _keys(part, (*above, name))


def _parts(annotation: Any) -> Iterator[Any]:
    """Give a type, the types inside it, and what is annotated to them."""
    yield annotation
    for part in get_args(annotation):
        yield from _parts(part)
