"""The released contract of each product, read from ``schemas/*.json``.

A schema lists every column with its dtype, unit, nullability and meaning, and the order of the
rows. Writers, readers and checks use it; a column is described nowhere else.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from starcat.errors import SchemaError, SchemaVersionError
from starcat.resources import resource_folder

if TYPE_CHECKING:
    import pyarrow as pa

SHOWN_CHARACTERS = 60

_FILE_NAME = re.compile(r"(?P<product>[a-z0-9_]+)-(?P<version>\d+\.\d+\.\d+)\.json", re.ASCII)


@dataclass(frozen=True)
class SchemaColumn:
    """One column of a product."""

    name: str  # the name in every file and query
    dtype: str  # ``int32``, ``float64``, ``string`` …, or ``list<int32>`` for a ragged column
    description: str
    unit: str = ""  # empty if the column has no unit
    nullable: bool = False  # True if values can be missing
    ucd: str = ""  # IVOA content descriptor, or empty
    refers_to: str = ""  # product to whose rows the values refer; empty for other values
    in_database: bool = True  # True if the matcher's HDF5 file has the column

    @property
    def is_list(self) -> bool:
        """Whether the rows are lists of different lengths."""
        return self.dtype.startswith("list<")

    @property
    def item_dtype(self) -> str:
        """The dtype of a value, or of a list's items."""
        return self.dtype[5:-1] if self.is_list else self.dtype

    @property
    def datasets(self) -> tuple[str, ...]:
        """Names of its datasets in the matcher's HDF5 file: one, or two of a list."""
        return (f"{self.name}_offsets", f"{self.name}_values") if self.is_list else (self.name,)

    @property
    def facts(self) -> dict[str, str]:
        """Unit, description and UCD (those that exist), for the metadata of a field."""
        texts = {"unit": self.unit, "description": self.description, "ucd": self.ucd}
        return {key: text for key, text in texts.items() if text}

    @property
    def arrow_field(self) -> pa.Field:
        """The column as a pyarrow field, with unit and meaning as metadata."""
        import pyarrow as pa  # other uses of a schema do not need it

        kind = pa.type_for_alias(self.item_dtype)
        if self.is_list:
            kind = pa.list_(pa.field("item", kind, nullable=False))
        return pa.field(self.name, kind, self.nullable, self.facts)


@dataclass(frozen=True)
class ProductSchema:
    """The contract of one product at one version."""

    product: str  # name and semantic version; the file is ``<product>-<version>.json``
    version: str
    description: str  # meaning of a row
    order: tuple[str, ...]  # columns by which the rows are sorted; together they are unique
    columns: tuple[SchemaColumn, ...]

    @property
    def name(self) -> str:
        """``<product>-<version>``."""
        return f"{self.product}-{self.version}"

    @property
    def summary(self) -> str:
        """The meaning of a row, without further remarks."""
        return re.split(r"[.:;] ", self.description)[0].rstrip(".")

    @cached_property
    def arrow_schema(self) -> pa.Schema:
        """The columns as a pyarrow schema with units and meanings as field metadata."""
        import pyarrow as pa

        metadata = {"starcat.schema": self.name}
        return pa.schema([column.arrow_field for column in self.columns], metadata)

    def check(self, table: pa.Table) -> None:
        """Check that a table has exactly the columns of the schema."""
        expected = [column.name for column in self.columns]
        if table.column_names != expected:
            odd = sorted(set(table.column_names) ^ set(expected)) or table.column_names
            raise SchemaError(
                f"columns differ from {self.name}: {', '.join(odd)}",
                where=self.product,
                product=self.product,
                found=table.column_names,
                expected=expected,
            )
        self.check_values(table)

    def check_values(
        self,
        table: pa.Table,
        where: str | None = None,
        hint: str = "",
        *,
        must_be_finite: bool = False,
    ) -> None:
        """Check the values of the columns that a table has: their types, and that none is missing.

        Only nullable columns can lack values. NaN is no value; infinity is one, such as the radius
        of the circle through three stars in a line, unless numbers have to be finite.
        """
        import pyarrow.compute as pc

        for column in self.columns:
            if column.name not in table.column_names:
                continue
            values, kind = table[column.name], column.arrow_field.type
            problem, found = "", str(values.type)
            if values.type != kind:
                problem = f"found {found}; {self.name} says {kind}"
            elif not column.nullable:
                missing = values.null_count
                if column.dtype.startswith("float"):
                    is_missing = (
                        pc.invert(pc.is_finite(values)) if must_be_finite else pc.is_nan(values)
                    )
                    missing += pc.sum(is_missing).as_py() or 0
                found = f"{missing} rows have no value"
                problem = f"{found}; {self.name} allows none" if missing else ""
            if problem:
                raise SchemaError(
                    problem,
                    where=f"{where}: {column.name}" if where else f"{self.product}.{column.name}",
                    product=self.product,
                    field=column.name,
                    found=found,
                    expected=str(kind),
                    hint=hint,
                )


def read_schema(path: Path) -> ProductSchema:
    """Read a schema file, with the columns of the schema that it extends."""
    content = json.loads(path.read_text(encoding="utf-8"))
    columns: list[SchemaColumn] = []
    if "extends" in content:
        base = read_schema(path.with_name(f"{content['extends']}.json"))
        loose = bool(content.get("extends_as_nullable", False))
        columns += [
            replace(c, nullable=c.nullable or loose)
            for c in base.columns
            if c.name not in content.get("extends_without", ())
        ]
    columns += [SchemaColumn(**column) for column in content["columns"]]
    facts = {name: content[name] for name in ("product", "version", "description")}
    return ProductSchema(**facts, order=tuple(content["order"]), columns=tuple(columns))


@cache
def product_schema(product: str, version: str | None = None) -> ProductSchema:
    """Return the schema of a product.

    Examples
    --------
    >>> product_schema("stars").order
    ('star_id',)
    """
    files = _schema_files().get(product, {})
    number = max(files, key=_version_key, default=None) if version is None else version
    if number is None or number not in files:
        readable = ", ".join(sorted(files, key=_version_key)) or "none"
        # Both can come from the footer of an untrusted file, with any length.
        requested = _shown("any" if version is None else version)
        raise SchemaVersionError(
            f"schema version {requested} found; this starcat reads: {readable}",
            where=_shown(product),
            product=product,
            found=version,
            expected=readable,
            hint="Install the starcat that wrote it, or a newer one",
        )
    return read_schema(files[number])


def _schema_files() -> dict[str, dict[str, Path]]:
    """Return the schema files of tables by product and version; the manifest is left out."""
    files: dict[str, dict[str, Path]] = {}
    for path in sorted(resource_folder("schemas").iterdir()):
        match = _FILE_NAME.fullmatch(path.name)
        if match and match["product"] != "manifest":
            files.setdefault(match["product"], {})[match["version"]] = path
    return files


def _shown(text: str) -> str:
    """Return an untrusted text, shortened to fit into one line."""
    is_short = text.isprintable() and len(text) <= SHOWN_CHARACTERS
    return text if is_short else ascii(text[:SHOWN_CHARACTERS])


def _version_key(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in version.split("."))
