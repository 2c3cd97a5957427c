"""Documents that describe a TAP service: VOSI's, DALI's examples, errors as VOTable.

The XML is made by vo-models, which has the elements of each schema in their order.

References
----------
VOSI 1.1, TAPRegExt 1.1, VODataService 1.1, DALI 1.1 section 4.4.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from html import escape as html_escape
from typing import Any, Literal, TypeVar
from xml.sax.saxutils import escape

from pydantic import AnyUrl, field_validator
from vo_models.tapregext.models import (
    DataLimit,
    DataLimits,
    Language,
    LanguageFeature,
    LanguageFeatureList,
    OutputFormat,
    TableAccess,
    TimeLimits,
    UploadMethod,
    Version,
)
from vo_models.vodataservice.models import DataType, ForeignKey, TableParam, TableSchema
from vo_models.vodataservice.models import Table as TableElement
from vo_models.voresource.models import AccessURL, Capability, Interface
from vo_models.voresource.types import UTCTimestamp
from vo_models.vosi.availability.models import Availability
from vo_models.vosi.capabilities.models import VOSICapabilities
from vo_models.vosi.tables.models import VOSITable, VOSITableSet

from starcat.query import POSITION
from starcat.ship.exchange import TAP_FORMATS
from starcat_service.protocols.adql import EXTENSIONS, USER_FUNCTIONS
from starcat_service.protocols.adql_shapes import GEOMETRY
from starcat_service.protocols.tables import (
    NAME,
    Schema,
    Tables,
    TapColumn,
    TapTable,
    adql_name,
    full_name,
)
from starcat_service.protocols.uws import document, xml_text

MEDIA_TYPE = "application/xml"
VOTABLE_TYPE = "application/x-votable+xml"

Element = TypeVar("Element", VOSITable, TableElement, TableSchema)

_FEATURES = "ivo://ivoa.net/std/TAPRegExt#features-"
_EXTENSIONS = "urn:starcat:adql-extensions"
_VOSI = "ivo://ivoa.net/std/VOSI#"

LANGUAGE_FEATURES: tuple[tuple[str, tuple[tuple[str, str], ...]], ...] = (
    ("udf", USER_FUNCTIONS),
    ("adqlgeo", tuple((name, "") for name in GEOMETRY)),
    ("adql-string", (("LOWER", ""), ("UPPER", ""), ("ILIKE", ""))),
    ("adql-sets", (("UNION", ""), ("EXCEPT", ""), ("INTERSECT", ""))),
    ("adql-common-table", (("WITH", ""),)),
    ("adql-type", (("CAST", ""),)),
    ("adql-unit", (("IN_UNIT", ""),)),
    ("adql-offset", (("OFFSET", ""),)),
    (_EXTENSIONS, EXTENSIONS),
)
"""Optional features of ADQL that exist here; at the end the syntax beyond ADQL."""


_EXAMPLES = (
    (
        "tables",
        "All tables, with what a row of each is",
        f"SELECT table_name, description FROM {NAME}.tables ORDER BY table_name",
    ),
    (
        "cone",
        "Stars within 10 degrees of a place, the brightest first",
        "SELECT *, DISTANCE({point}, POINT('ICRS', 83.6, -5.4)) AS separation_deg FROM {stars} "
        "WHERE 1 = CONTAINS({point}, CIRCLE('ICRS', 83.6, -5.4, 10)) ORDER BY mag",
    ),
    (
        "polygon",
        "Stars within a polygon",
        "SELECT TOP 100 * FROM {stars} "
        "WHERE 1 = CONTAINS({point}, POLYGON('ICRS', 70, -20, 110, -20, 90, 20))",
    ),
    (
        "counts",
        "Stars by whole magnitudes",
        "SELECT magnitude, COUNT(*) AS stars FROM (SELECT FLOOR(mag) AS magnitude FROM {stars}) "
        "AS m GROUP BY magnitude ORDER BY magnitude",
    ),
)


@dataclass(frozen=True)
class ServiceLimits:
    """What the service grants."""

    # Time limits of a query, and of keeping its answer, seconds.
    run_s: int
    keep_s: int
    # Most rows of an answer, and most bytes of an upload.
    rows: int
    upload_bytes: int


class _Column(TableParam, tag="column"):
    """A column whose description is escaped once, when XML is written, and not twice."""

    @field_validator("description")
    def validate_description(cls, value: str) -> str:  # noqa: N805 - so pydantic calls it
        return value


def capabilities(base_url: str, limits: ServiceLimits) -> bytes:
    """Return what the service can do."""
    others = [
        (f"{_VOSI}capabilities", "capabilities", None),
        (f"{_VOSI}availability", "availability", None),
        (f"{_VOSI}tables-1.1", "tables", "1.1"),
        ("ivo://ivoa.net/std/DALI#examples", "examples", None),
    ]
    vosi: list[Capability] = [
        Capability(
            standard_id=AnyUrl(name), interface=[_interface(f"{base_url}/{path}", "full", version)]
        )
        for name, path, version in others
    ]
    model = VOSICapabilities(capability=[_table_access(base_url, limits), *vosi])
    return document(model, skip_empty=True)


def _table_access(base_url: str, limits: ServiceLimits) -> TableAccess:
    rows = DataLimit(value=limits.rows, unit="row")
    size = DataLimit(value=limits.upload_bytes, unit="byte")
    language = Language(
        name="ADQL",
        version=[
            Version(value="2.1", ivo_id="ivo://ivoa.net/std/ADQL#v2.1"),
            Version(value="2.0", ivo_id="ivo://ivoa.net/std/ADQL#v2.0"),
        ],
        description="ADQL 2.1. All places are ICRS, degrees.",
        language_features=[
            LanguageFeatureList(
                type=kind if ":" in kind else f"{_FEATURES}{kind}",
                feature=[
                    LanguageFeature(form=form, description=description or None)
                    for form, description in forms
                ],
            )
            for kind, forms in LANGUAGE_FEATURES
        ],
    )
    return TableAccess(
        interface=[_interface(base_url, "base", "1.1", role="std")],
        language=[language],
        output_format=[
            OutputFormat(
                mime=tap_format.tap_type,
                alias=[
                    tap_format.name,
                    *(a for a in tap_format.aliases if "/" not in a or ";" not in a),
                ],
                ivo_id=tap_format.standard_id or None,
            )
            for tap_format in TAP_FORMATS
        ],
        upload_method=[
            UploadMethod(ivo_id=f"ivo://ivoa.net/std/TAPRegExt#upload-{kind}")
            for kind in ("inline", "http")
        ],
        retention_period=TimeLimits(default=limits.keep_s, hard=limits.keep_s),
        execution_duration=TimeLimits(default=limits.run_s, hard=limits.run_s),
        output_limit=DataLimits(default=rows, hard=rows),
        upload_limit=DataLimits(default=size, hard=size),
    )


def _interface(
    url: str, use: Literal["full", "base"], version: str | None, role: str | None = None
) -> Interface:
    address = AccessURL(value=AnyUrl(url), use=use)
    return Interface(type="vs:ParamHTTP", access_url=[address], version=version, role=role)


def availability(up_since: datetime) -> bytes:
    """Return that the service is available."""
    since = UTCTimestamp.fromisoformat(up_since.strftime("%Y-%m-%dT%H:%M:%SZ"))
    return document(Availability(available=True, up_since=since), skip_empty=True)


def tableset(tables: Tables, with_columns: bool = True) -> bytes:
    """Return all schemas and tables."""
    schemas = [_schema(schema, with_columns) for schema in tables.schemas]
    return document(VOSITableSet(tableset_schema=schemas), skip_empty=True)


def for_tap_plus(tables: bytes) -> bytes:
    """Return a document of tables in the format that TapPlus of astroquery reads."""
    space = b'<vosi:tableset xmlns:esatapplus="http://esa.int/xml/EsaTapPlus" '
    named = tables.replace(b"<vosi:tableset ", space, 1)
    return named.replace(b"<column>", b'<column esatapplus:flags="0">')


def table_document(table: TapTable) -> bytes:
    """Return a table with its columns."""
    model = _described(VOSITable(**_about(table, True)), table.description)
    return document(model, skip_empty=True)


def _schema(schema: Schema, with_columns: bool) -> TableSchema:
    tables = [
        _described(TableElement(**_about(table, with_columns)), table.description)
        for table in schema.tables
    ]
    model = TableSchema(schema_name=adql_name(schema.name), table=tables)
    return _described(model, schema.description)


def _described(element: Element, text: str) -> Element:
    """Give an element its description, which its constructor would escape twice."""
    element.description = text or None
    return element


def _about(table: TapTable, with_columns: bool) -> dict[str, Any]:
    about: dict[str, Any] = {"table_type": "table", "table_name": full_name(table)}
    if not with_columns:
        return about
    columns = [
        _Column(
            column_name=adql_name(column.name),
            description=column.description or None,
            unit=column.unit or None,
            ucd=column.ucd or None,
            xtype=column.xtype or None,
            datatype=DataType(value=column.datatype, arraysize=column.arraysize or None),
            flag=_flags(column),
        )
        for column in table.columns
    ]
    keys = [
        ForeignKey(
            target_table=key.target,
            from_column=key.column,
            target_column=key.target_column,
            description=key.description or None,
        )
        for key in table.keys
    ]
    return {**about, "column": columns, "foreign_key": keys}


def _flags(column: TapColumn) -> list[str]:
    flags = {"principal": column.is_principal, "indexed": column.is_indexed}
    return [name for name, is_so in {**flags, "std": column.is_standard}.items() if is_so]


def error_votable(message: str) -> bytes:
    """Return an error as DALI has it."""
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        '<VOTABLE version="1.4" xmlns="http://www.ivoa.net/xml/VOTable/v1.3">\n'
        '<RESOURCE type="results">\n'
        f'<INFO name="QUERY_STATUS" value="ERROR">{escape(xml_text(message))}</INFO>\n'
        "</RESOURCE>\n</VOTABLE>\n"
    ).encode()


def examples(tables: Tables) -> list[tuple[str, str, str]]:
    """Return queries that run on the existing tables: names, titles and texts."""
    with_places = [
        table for table in tables if {*POSITION, "mag"} <= {column.name for column in table.columns}
    ]
    # The table of rejected stars also has positions.
    stars = min(with_places, key=lambda table: table.name != "stars", default=None)
    point = f"POINT('ICRS', {', '.join(map(adql_name, POSITION))})"
    runnable = [
        example for example in _EXAMPLES if stars is not None or "{stars}" not in example[2]
    ]
    name = full_name(stars) if stars is not None else ""
    return [(word, title, query.format(stars=name, point=point)) for word, title, query in runnable]


def examples_page(tables: Tables) -> str:
    """Return a page with the examples."""
    parts = "\n".join(
        f'<div typeof="example" id="{name}" resource="#{name}">\n'
        f'<h2 property="name">{html_escape(title)}</h2>\n'
        f'<pre property="query">{html_escape(query)}</pre>\n</div>'
        for name, title, query in examples(tables)
    )
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<!DOCTYPE html>\n'
        '<html xmlns="http://www.w3.org/1999/xhtml" lang="en">\n'
        "<head><title>Examples of ADQL</title></head>\n"
        '<body vocab="http://www.ivoa.net/rdf/examples#">\n'
        f"<h1>Examples of ADQL</h1>\n{parts}\n</body>\n</html>\n"
    )
