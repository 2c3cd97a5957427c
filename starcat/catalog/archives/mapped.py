"""The user's own tables: a map gives the rows their meaning.

Rows become records with one column per value of the map, in the units of the star table but in
the frame of the map; then positions and proper motions are transformed to ICRS. If the rows are
the records of an archive, they become such records, and the archive's module does the rest.
"""

from __future__ import annotations

import hashlib
import importlib
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from decimal import Decimal
from typing import Any, cast

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from starcat.arrays import Array, Mask
from starcat.catalog.frames import icrs_from
from starcat.catalog.readers.records import (
    MalformedRecord,
    ParsedRecords,
    Rows,
    TableColumn,
    check_record_fields,
)
from starcat.catalog.readers.tables import BLANKS, MINUS, OpenTable
from starcat.catalog.source import SourceColumn, data_source
from starcat.catalog.source_files import InputFile
from starcat.catalog.stars.expressions import columns_in, evaluate_expression
from starcat.catalog.stars.star_table import Columns, known_errors, where_known
from starcat.catalog.stars.verdict import Quality, Reason, Verdicts, quality_flags
from starcat.catalog.table_map import (
    ASSUMED,
    UNITS,
    AnyMap,
    ArchiveMap,
    TableMap,
    Value,
    unit_of_column,
)
from starcat.errors import ConfigError, literal, quoted

_WHOLE = re.compile(r"([+-]?[0-9]{1,19})(\.0*)?")
_FLOATING = r"^[+-]?[0-9]+\.[0-9]*([eE]\+?[0-9]{1,3})?$"
_EXACT = {pa.float16(): 2**11, pa.float32(): 2**24, pa.float64(): 2**53}
"""Largest whole number up to which a floating type has all of them."""
_INT64 = range(-(2**63), 2**63)
_SEXAGESIMAL = (
    r"^(?P<sign>[+-]?)\s*(?P<whole>[0-9]{1,3})[\s:hHdD°]+(?P<minutes>[0-5]?[0-9])[\s:mM'′]+"
    r"(?P<seconds>[0-5]?[0-9](?:\.[0-9]*)?|60(?:\.0*)?)[\ss\"″]*$"
)
"""Hours or degrees, minutes and seconds; rounding makes 60 seconds of 59.996."""
_SINGLE_DECIMALS = 6  # for magnitudes and fields of four bytes, which have 7 digits
_TEXTS = ("columns.star_id", "columns.designation", "columns.spectral_type")


@dataclass(frozen=True)
class Understood:
    """A value of a map, resolved for a file."""

    value: Value
    columns: tuple[str, ...]  # columns of the file that it uses
    is_column: bool  # True for a column as it is, False for an expression or a number
    unit: str  # unit in the file; empty for texts, conditions and pure numbers
    becomes: str  # unit of the star table or of the archive's field, or empty
    convert: Callable[[Array], Array]  # conversion to that unit


def understand(
    table: AnyMap, columns: Mapping[str, TableColumn], where: str
) -> dict[str, Understood]:
    """Resolve the values of a map for the columns of a file."""
    understood = {}
    fields = _fields_of(table) if isinstance(table, ArchiveMap) else {}
    for key, value in table.values.items():
        if isinstance(value.value, str):
            named, is_column = columns_in(value.value, list(columns), key, where)
        else:
            named, is_column = (), False
        unit, convert = "", cast(Callable[[Array], Array], _as_is)
        target, assumed = _units(key, fields)
        if target:
            column = columns[named[0]] if is_column else None
            unit, convert = _unit(key, value, column, where, target, assumed)
        understood[key] = Understood(value, named, is_column, unit, target, convert)
    return understood


def _units(key: str, fields: Mapping[str, SourceColumn]) -> tuple[str, str]:
    """Return the unit of a value in the star table, and its default unit in the file."""
    kind, _, name = key.partition(".")
    if kind == "fields":
        unit = (fields[name].unit or "").replace("cas", "0.01 arcsec")
        return unit, unit
    if kind.startswith("magnitude"):
        return "mag", "mag"
    return UNITS.get(name, ""), ASSUMED.get(name, "")


def _fields_of(table: ArchiveMap) -> dict[str, SourceColumn]:
    """Return the fields that the module of an archive reads; the map must define all of them."""
    archive = data_source(table.archive)
    module = importlib.import_module(archive.python)
    layout = archive.main_file
    if lacking := [name for name in module.COLUMNS[layout.name] if name not in table.fields]:
        raise ConfigError(
            f"{table.archive} also needs {', '.join(lacking)}", where="fields", key="fields"
        )
    return {name: layout.column(name) for name in table.fields}


def _unit(
    key: str, value: Value, column: TableColumn | None, where: str, expected: str, assumed: str
) -> tuple[str, Callable[[Array], Array]]:
    from astropy import units

    kind, _, name = key.partition(".")
    stated = column.unit if column and ":" not in column.unit else ""
    text = value.unit or stated or assumed
    if not text:
        raise ConfigError(
            f"neither {where} nor the map states a unit",
            where=key,
            key=key,
            hint=f'write it, such as {{{{ value = "{literal(value.value)}", unit = '
            f'"{expected.replace(" ", "")}" }}}}',
        )
    try:
        unit = unit_of_column(text)
        if kind == "magnitudes" and unit.physical_type == "spectral flux density":
            return text, lambda flux: _ab_magnitudes(flux, unit)
        if expected == "mag" and isinstance(unit, units.MagUnit):
            return text, _as_is
        # An hour or a second of right ascension is 15 degrees or 15 arcsec.
        second, arcsec = units.s, units.Unit(15.0 * units.arcsec)
        same = [(second, arcsec), (second / units.yr, arcsec / units.yr)]
        turns = same if name in ("ra", "ra_error", "pm_ra", "pm_ra_cosdec", "pm_ra_error") else []
        factor = float(unit.to(unit_of_column(expected), 1.0, equivalencies=turns))
        return text, lambda values: np.asarray(values * factor)
    except (units.UnitConversionError, ValueError) as error:
        origin = "of the map" if value.unit else f"of {where}"
        is_unit = isinstance(error, units.UnitConversionError)
        why = f"cannot be converted to {expected}" if is_unit else f"is refused: {error}"
        raise ConfigError(
            f"unit {text!r} ({origin}) {why}",
            where=key,
            key=key,
            value=text,
            hint="state the right one with 'unit' in the map",
        ) from error


def _floats(values: pa.Array) -> Array:
    numbers = values.cast(pa.float64(), safe=False)
    return np.array(pc.fill_null(numbers, float("nan")), dtype=np.float64)


def _as_is(values: Array) -> Array:
    return values


def _ab_magnitudes(flux: Array, unit: Any) -> Array:
    from astropy import units

    positive = np.where(flux > 0.0, flux, np.nan)
    return np.asarray((positive * unit).to_value(units.ABmag), dtype=np.float64)


def needed_columns(table: AnyMap, opened: OpenTable, *, where: str) -> list[str]:
    """Return the columns of a file that a map needs."""
    understood = understand(table, opened.columns, where)
    return list(dict.fromkeys(name for entry in understood.values() for name in entry.columns))


class _Reading:
    """Rows of a table during their conversion to records."""

    def __init__(self, table: AnyMap, rows: Rows, where: str) -> None:
        self.map = table
        self.rows = rows
        self.count = len(rows.number)
        self.entries = understand(table, rows.columns, where)
        self.bad = np.zeros(self.count, dtype=bool)
        self.problems: list[MalformedRecord] = []
        self._nulls = pa.array(sorted({str(text) for text in table.null}), pa.string())
        self._null_numbers = [float(text) for text in table.null if _is_number(text)]

    def column(self, name: str, key: str, *, as_text: bool = False) -> pa.Array:
        """Return a column, with nulls for missing values.

        Texts of numbers become numbers unless ``as_text`` is set.
        """
        values = self.rows.table[name].combine_chunks()
        if pa.types.is_string(values.type):
            values = pc.utf8_trim_whitespace(values)
            is_blank = pc.match_substring_regex(values, BLANKS)
            values = self._blanked(values, pc.or_(is_blank, pc.is_in(values, self._nulls)))
            # Within an expression a single dash can be the sign of an angle.
            if self.entries[key].is_column or self.rows.columns[name].has_numbers:
                values = self._blanked(values, pc.equal(values, "-"))
            if as_text or self.rows.columns[name].is_text:
                return values
            return self._numbers(values, key)
        if pa.types.is_floating(values.type):
            values = self._blanked(values, pc.is_nan(values))
        if pa.types.is_floating(values.type) or pa.types.is_integer(values.type):
            return self._no_number(values)
        return values

    @staticmethod
    def _blanked(values: pa.Array, where: pa.Array) -> pa.Array:
        return pc.if_else(pc.fill_null(where, False), pa.scalar(None, values.type), values)

    def _numbers(self, texts: pa.Array, key: str) -> pa.Array:
        """Return texts as numbers; the rows of other texts are malformed."""
        texts = _with_minus(texts)
        with suppress(pa.ArrowInvalid):
            return self._no_number(texts.cast(pa.int64()))
        try:
            numbers = texts.cast(pa.float64())
        except pa.ArrowInvalid:
            is_number = pc.match_substring_regex(texts, r"^[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?$")
            wrong = pc.invert(pc.fill_null(is_number, True))
            self.refuse(wrong.to_numpy(zero_copy_only=False), key, texts, "a number")
            numbers = self._blanked(texts, wrong).cast(pa.float64())
        return self._no_number(self._blanked(numbers, pc.is_nan(numbers)))

    def _no_number(self, numbers: pa.Array) -> pa.Array:
        """Return numbers, with nulls for the numbers that mean no value in the map."""
        if not self._null_numbers:
            return numbers
        # A column of four bytes has the nearest of its own numbers.
        kind = numbers.type if pa.types.is_floating(numbers.type) else pa.float64()
        nulls = pa.array(self._null_numbers, pa.float64()).cast(kind, safe=False)
        return self._blanked(numbers, pc.is_in(numbers.cast(kind, safe=False), nulls))

    def refuse(self, wrong: Mask, key: str, values: pa.Array, expected: str) -> None:
        """Leave out rows with an impossible value."""
        for i in np.flatnonzero(wrong & ~self.bad):
            text = quoted(str(values[i].as_py()))
            row = int(self.rows.number[i])
            self.problems.append(MalformedRecord(row, key, None, text, expected, what="row"))
        self.bad |= wrong

    def value(self, key: str, *, as_text: bool = False) -> pa.Array:
        """Return the value of a key of the map (column, expression or number) for every row."""
        entry = self.entries[key]
        if not isinstance(entry.value.value, str):
            return pa.repeat(pa.scalar(float(entry.value.value)), self.count)
        if entry.is_column:
            return self.column(entry.columns[0], key, as_text=as_text)
        columns = {name: self.column(name, key) for name in entry.columns}
        return evaluate_expression(entry.value.value, columns, self.count, key)

    def numbers(self, key: str) -> Array:
        """Return numbers in the unit of the star table, NaN for missing values."""
        values = self.value(key)
        is_angle = key in ("columns.ra", "columns.dec") and pa.types.is_string(values.type)
        if is_angle:
            return self._angles(values, key)
        if pa.types.is_string(values.type) and self.entries[key].is_column:
            values = self._numbers(values, key)
        if not (pa.types.is_floating(values.type) or pa.types.is_integer(values.type)
                or pa.types.is_decimal(values.type) or pa.types.is_null(values.type)):  # fmt: skip
            raise ConfigError(
                f"{self.entries[key].value.value!r} gives {values.type}; expected numbers",
                where=key,
                key=key,
            )
        array = _floats(values)
        array[np.isinf(array)] = np.nan
        array = self.entries[key].convert(array)
        is_light = key.startswith(("magnitudes.", "magnitude_errors.", "fields."))
        if is_light and pa.types.is_float32(values.type):
            return np.asarray(np.round(array, _SINGLE_DECIMALS))
        return array

    def _angles(self, texts: pa.Array, key: str) -> Array:
        """Return angles of sexagesimal or decimal texts; right ascensions are in hours."""
        texts = _with_minus(texts)
        parts = pc.extract_regex(texts, _SEXAGESIMAL)
        is_split = np.asarray(pc.is_valid(parts))
        number = {
            name: np.array(pc.struct_field(parts, name).cast(pa.float64()).fill_null(0.0))
            for name in ("whole", "minutes", "seconds")
        }
        size = number["whole"] + number["minutes"] / 60.0 + number["seconds"] / 3600.0
        negative = np.array(pc.fill_null(pc.equal(pc.struct_field(parts, "sign"), "-"), False))
        entry = self.entries[key]
        plain = self._numbers(
            pc.if_else(parts.is_valid(), pa.scalar(None, pa.string()), texts), key
        )
        decimal = entry.convert(_floats(plain))
        is_galactic = isinstance(self.map, TableMap) and self.map.frame == "galactic"
        is_hours = key == "columns.ra" and not is_galactic and entry.value.unit is None
        signed = np.where(negative, -size, size)
        return np.where(is_split, 15.0 * signed if is_hours else entry.convert(signed), decimal)

    def texts(self, key: str) -> NDArray[Any]:
        """Return texts, None for missing values."""
        values = self.value(key, as_text=True)
        if pa.types.is_floating(values.type):
            rounded = pc.round(values)
            if pc.all(pc.equal(rounded, values)).as_py() is not False:
                values = rounded.cast(pa.int64())
        return np.asarray(values.cast(pa.string()).to_pylist(), dtype=object)

    def field(self, key: str, column: SourceColumn) -> NDArray[Any]:
        """Return a field of an archive's records as its readers do: texts are bytes, or blank.

        If a table has a flag with one digit per band as a number, leading zeros are restored.
        """
        if column.is_text:
            values = self.value(key, as_text=True)
            texts = pc.fill_null(values.cast(pa.string()), "")
            if pa.types.is_integer(values.type) and column.format[1:]:
                width = int(column.format[1:])
                texts = pc.if_else(values.is_valid(), pc.utf8_lpad(texts, width, "0"), texts)
            return np.array(texts.cast(pa.binary()).to_pylist() or [b""], dtype="S")[: self.count]
        if column.format.startswith("<i"):
            values = self.value(key)
            wrong = np.asarray(values.is_null()) | (not pa.types.is_integer(values.type))
            self.refuse(wrong, key, values, "a whole number")
            return np.array(pc.fill_null(values, 0).cast(pa.int64(), safe=False), dtype=np.int64)
        array = self.numbers(key)
        return np.round(array, _SINGLE_DECIMALS) if column.is_integer else array

    def holds(self, key: str) -> Mask:
        """Return the rows for which a condition holds."""
        values = self.value(key)
        try:
            values = values.cast(pa.bool_())
        except (pa.ArrowInvalid, pa.ArrowNotImplementedError) as error:
            raise ConfigError(
                f"{self.entries[key].value.value!r} gives texts",
                where=key,
                key=key,
                hint=f"write a condition, such as {literal(self.entries[key].columns[0])} = 'D'",
            ) from error
        return np.asarray(pc.fill_null(values, False).to_numpy(zero_copy_only=False), dtype=bool)

    def identities(self) -> tuple[NDArray[np.int64], NDArray[Any]]:
        """Return the numbers of stars (0 if missing), and their texts."""
        key = "columns.star_id"
        values = self.value(key, as_text=True)
        if pa.types.is_floating(values.type):
            array = np.array(pc.fill_null(values, 0.0), dtype=np.float64)
            rounded = np.abs(array) > _EXACT[values.type]
            self.refuse(rounded, key, values, _rounded_above(_EXACT[values.type]))
            wrong = array != np.trunc(array)
            self.refuse(wrong, key, values, "a whole number, or a text")
            values = pa.array(
                np.where(wrong | rounded, 0.0, array).astype(np.int64),
                mask=np.asarray(values.is_null()),
            )
        elif pa.types.is_string(values.type):
            values = self._whole_texts(values, key)
        texts = np.asarray(values.cast(pa.string()).to_pylist(), dtype=object)
        with suppress(pa.ArrowInvalid):
            if pa.types.is_integer(values.type):
                return np.array(pc.fill_null(values.cast(pa.int64()), 0)), texts
        return np.array([identity(text) for text in texts], dtype=np.int64), texts

    def _whole_texts(self, values: pa.Array, key: str) -> pa.Array:
        """Return texts of identifiers: ``4.5000000e+07`` becomes 45000000; refuse rounded ones.

        Programs that read whole numbers as floating-point numbers write them like this.
        """
        floating = pc.fill_null(pc.match_substring_regex(values, _FLOATING), False)
        if not pc.any(floating).as_py():
            return values
        texts, largest = values.to_pylist(), _EXACT[pa.float64()]
        rounded, short = np.zeros((2, self.count), dtype=bool)
        for i in np.flatnonzero(floating.to_numpy(zero_copy_only=False)):
            mantissa, _, power = texts[i].lower().partition("e")
            number = Decimal(texts[i])
            rounded[i] = abs(number) > largest
            short[i] = len(mantissa.partition(".")[2]) < int(power or 0)
            if power and number == number.to_integral_value():
                texts[i] = str(int(number))
        self.refuse(rounded, key, values, _rounded_above(largest))
        self.refuse(short, key, values, "a whole number with all of its digits, or a text")
        return pa.array(texts, pa.string())


def _rounded_above(largest: int) -> str:
    """Return what is expected instead of a whole number that a program has rounded."""
    return (
        f"an exact identifier; identifiers above 2^{largest.bit_length() - 1} are rounded in "
        "floating-point numbers, so that different stars get the same one. Get the table again "
        "with the identifiers as whole numbers of 64 bits or as texts"
    )


def _with_minus(texts: pa.Array) -> pa.Array:
    """Return texts of numbers with a minus sign that programs read."""
    return pc.replace_substring_regex(texts, f"^{MINUS}", "-")


def identity(text: str | None) -> int:
    """Return the permanent number for the name of a star; 0 for no name.

    A text of digits is the number itself, if it fits into 64 bits with a sign (below 2^63). Any
    other text, including a larger number, becomes 62 bits of its SHA-256.
    """
    if text is None:
        return 0
    if (whole := _WHOLE.fullmatch(text)) and int(whole[1]) in _INT64:
        return int(whole[1])
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big") >> 2


def _is_number(value: str | float) -> bool:
    try:
        float(value)
    except ValueError:
        return False
    return True


def records_of(table: TableMap | ArchiveMap, rows: Rows, file: InputFile) -> ParsedRecords:
    """Return rows as records: the values of the map by key, in the map's frame.

    Rows that are records of an archive get its fields and the same checks as its files.
    """
    reading = _Reading(table, rows, file.path.name)
    if isinstance(table, ArchiveMap):
        return _archive_records(table, reading)
    columns: dict[str, NDArray[Any]] = {}
    columns["columns.star_id"], columns["star_text"] = reading.identities()
    for key in reading.entries:
        if key == "columns.star_id":
            continue
        if key.split(".")[0] in ("flags", "reject", "quality"):
            columns[key] = reading.holds(key)
        elif key in _TEXTS:
            columns[key] = reading.texts(key)
        else:
            columns[key] = reading.numbers(key)
    records = ParsedRecords(table.name, rows.number, columns, rows.problems)
    records = records.without(reading.bad, reading.problems)
    return hook_of(table)(records) if table.python else records


def _archive_records(table: ArchiveMap, reading: _Reading) -> ParsedRecords:
    fields, layout = _fields_of(table), data_source(table.archive).main_file
    columns = {name: reading.field(f"fields.{name}", column) for name, column in fields.items()}
    rows = reading.rows
    records = ParsedRecords(layout.name, rows.number, columns, rows.problems)
    checked = check_record_fields(records.without(reading.bad, reading.problems), layout)
    problems = [replace(problem, what="row", byte_range=None) for problem in checked.problems]
    return replace(checked, problems=problems)


def hook_of(table: TableMap) -> Callable[[ParsedRecords], ParsedRecords]:
    """Return the function that a shipped map names for computations beyond expressions."""
    module, _, name = table.python.partition(":")
    hook: Callable[[ParsedRecords], ParsedRecords] = getattr(importlib.import_module(module), name)
    return hook


@dataclass(frozen=True)
class MappedTable:
    """The meaning of the records of a table (an `Archive`)."""

    table: TableMap
    COLUMNS: Mapping[str, Sequence[str]]

    def magnitudes(self, records: ParsedRecords, band: str, /) -> Array:
        """Return the magnitudes of records."""
        return np.asarray(records[f"magnitudes.{band}"])

    def stars(self, records: ParsedRecords, band: str, verdicts: Verdicts, /) -> Columns:
        """Return the star-table columns of records, and reject records that are not stars."""
        has_no_name = np.array([text is None for text in records["star_text"]], dtype=bool)
        verdicts.reject(has_no_name, Reason.no_identity)
        for key, reason in _reasons(records, "reject"):
            verdicts.reject(records[key], Reason[reason])
        columns = _placed(self.table, records, verdicts)
        for key in ("parallax", "parallax_error", "radial_velocity"):
            unit = {"radial_velocity": "_km_s"}.get(key, "_mas")
            columns[key + unit] = _number(records, f"columns.{key}")
        flags = {Quality[name.upper()]: records[key] for key, name in _reasons(records, "quality")}
        columns["quality_flags"] = quality_flags(len(records), flags)
        return {**columns, **self._light(records, band), **self._remarks(records)}

    def _light(self, records: ParsedRecords, band: str) -> Columns:
        bands = self.table.ordered_bands
        columns: Columns = {
            "mag": self.magnitudes(records, band),
            "mag_error": known_errors(_number(records, f"magnitude_errors.{band}")),
            "band": band,
        }
        others = [other for other in bands if other != band]
        if others:
            columns |= {"second_mag": self.magnitudes(records, others[0]), "second_band": others[0]}
        if self.table.colour_bands:
            first, second = (
                self.magnitudes(records, colour_band) for colour_band in self.table.colour_bands
            )
            colour = np.round(first - second, _SINGLE_DECIMALS)
            columns |= {"colour_mag": colour, "colour_bands": str(self.table.colour)}
        return columns

    def _remarks(self, records: ParsedRecords) -> Columns:
        amplitude = _number(records, "columns.amplitude")
        star_texts = records["star_text"]
        names = records.columns.get(
            "columns.designation", np.full(len(star_texts), None, dtype=object)
        )
        columns: Columns = {
            "star_id": records["columns.star_id"],
            "designation": pa.array(
                [a or f"{self.table.name} {b}" for a, b in zip(names, star_texts, strict=True)],
                pa.string(),
            ),
            "amplitude_mag": amplitude,
            "amplitude_source": where_known(amplitude, self.table.name),
            "companion_separation_arcsec": _number(records, "columns.companion_separation"),
            "companion_delta_mag": _number(records, "columns.companion_delta_mag"),
            "ruwe": _number(records, "columns.ruwe"),
            "hip_number": _number(records, "columns.hip_number"),
            "hd_number": _number(records, "columns.hd_number"),
        }
        if "columns.spectral_type" in records.columns:
            columns["spectral_type"] = pa.array(records["columns.spectral_type"], pa.string())
        for kind in ("double", "variable"):
            key = f"flags.{kind}"
            if key in records.columns:
                where = pa.array(records[key])
                text = str(self.table.values[key].value)
                columns[f"is_flagged_{kind}"] = where
                columns[f"{kind}_flag"] = pc.if_else(where, text, pa.scalar(None, pa.string()))
        return columns


def _number(records: ParsedRecords, key: str) -> Array:
    values = records.columns.get(key)
    return np.full(len(records), np.nan) if values is None else np.asarray(values)


def _reasons(records: ParsedRecords, kind: str) -> list[tuple[str, str]]:
    return [(key, key.split(".", 1)[1]) for key in records.columns if key.startswith(f"{kind}.")]


def _placed(table: TableMap, records: ParsedRecords, verdicts: Verdicts) -> Columns:
    """Return positions, proper motions and their errors in ICRS; the errors keep their axes."""
    ra, dec = records["columns.ra"], records["columns.dec"]
    outside = (np.abs(ra) > 360.0) | (np.abs(dec) > 90.0)
    verdicts.reject(outside, Reason.impossible_value)
    ra, dec = np.where(outside, np.nan, ra % 360.0), np.where(outside, np.nan, dec)
    epoch: float | Array = table.epoch_jyear or _epochs(table, records["epoch"])
    pm_ra, pm_dec = _number(records, "columns.pm_ra_cosdec"), _number(records, "columns.pm_dec")
    if table.columns.pm_ra is not None:
        pm_ra = records["columns.pm_ra"] * np.cos(np.radians(dec))
    errors = {
        f"{key}{unit}": known_errors(_number(records, f"columns.{key}"))
        for key, unit in (
            *(("ra_error", "_mas"), ("dec_error", "_mas")),
            *(("pm_ra_error", "_mas_yr"), ("pm_dec_error", "_mas_yr")),
        )
    }
    if table.frame == "galactic":  # the axes differ: use the larger error for both
        for pair in (
            ("ra_error_mas", "dec_error_mas"),
            ("pm_ra_error_mas_yr", "pm_dec_error_mas_yr"),
        ):
            errors |= dict.fromkeys(pair, np.fmax(errors[pair[0]], errors[pair[1]]))
    if table.frame != "ICRS":
        ra, dec, pm_ra, pm_dec = icrs_from(table, ra, dec, epoch, pm_ra, pm_dec)
    central = np.where(np.isnan(errors["ra_error_mas"]), np.nan, epoch)
    return {
        "ra_deg": ra,
        "dec_deg": dec,
        "epoch_jyear": np.broadcast_to(epoch, len(ra)),
        "pm_ra_cosdec_mas_yr": pm_ra,
        "pm_dec_mas_yr": pm_dec,
        "ra_central_jyear": central,
        "dec_central_jyear": central,
        **errors,
    }


def _epochs(table: TableMap, values: Array) -> Array:
    """Return epochs as Julian years."""
    from astropy.time import Time

    if table.epoch.scale == "jyear":
        return values
    usual = {"byear": 1950.0, "jd": 2451545.0, "mjd": 51544.5}[table.epoch.scale]
    moments = Time(np.where(np.isnan(values), usual, values), format=table.epoch.scale, scale="tt")
    return np.where(np.isnan(values), np.nan, moments.jyear)
