"""A map proposed for a table, from the names, UCDs, units and first rows of its columns."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa

from starcat.catalog.readers.records import TableColumn
from starcat.catalog.readers.tables import ANY, SAMPLE_ROWS, open_table
from starcat.catalog.source import RecordFile, source_names
from starcat.catalog.source_files import InputFile, table_parts
from starcat.catalog.table_map import UNITS, unit_of_column
from starcat.errors import SourceMissing

_WHEN = r"(deg|rad|h|hr|hours?|hms|dms|mean|icrs|fk4|fk5|j|b|ep|epoch|[12][0-9]{3})*"
_ID = (
    "(gaia|source|src|obj|object|star|main|cat|catalog)?(id|no|nr|num|number|identifier|ident|name)"
)
_RULES = (
    ("ra", r"pos\.eq\.ra", rf"(ra|alpha|rightascension){_WHEN}"),
    ("dec", r"pos\.eq\.dec", rf"(de|decl?|delta|declination){_WHEN}"),
    ("ra", r"pos\.galactic\.lon", r"(glon|gall|lii|galacticlongitude)(deg|rad)?"),
    ("dec", r"pos\.galactic\.lat", r"(glat|galb|bii|galacticlatitude)(deg|rad)?"),
    ("pm_ra_cosdec", r"pos\.pm.*(\.ra|\.lon)", r"(pm|mu)(ra|alpha|a|l|glon)(star|cos(de?c?|b))?"),
    ("pm_dec", r"pos\.pm.*(\.dec|\.lat)", r"(pm|mu)(de|dec|decl|delta|d|b|glat)"),
    ("parallax", r"pos\.parallax", r"plx|parallax|prlx"),
    ("radial_velocity", r"spect\.dopplerveloc", r"h?rv|vrad|rad(ial)?vel(ocity)?"),
    ("epoch", r"time\.epoch", r"(obs|mean|ref)*(mjd|jd|jdate|epoch|ep|jyear|year)"),
    ("spectral_type", r"src\.sptype", r"sp|spt|sptype|spectral(type|class)?|spectype|mk"),
    ("ruwe", "", r"ruwe"),
    ("amplitude", r"src\.var\.amplitude", r"(var)?amp(l|litude)?"),
    ("hip_number", "", r"hip(no|id|number)?"),
    ("hd_number", "", r"hd(no|id|number)?"),
    (
        "flags.double",
        r"meta\.code\.multip",
        r"dup|dbl|(is)?double|mult(iple|flag)?|binary|nonsinglestar|ccdm",
    ),
    ("flags.variable", r"src\.var", r"(is)?var(iable)?(flag)?|vflag|photvariableflag|variability"),
    ("star_id", r"meta\.id", rf"{_ID}|recno|seq|tyc|sao|ptskey|designation"),
)
"""Key, UCD and name (small letters and digits) of possible columns, in the order of the search."""

_BANDS = (
    r"m(ag(nitude)?)?|(?P<band>[ubvrig]|[bv]t|bp|rp|hp|ks)",
    r"phot_(?P<band>g|bp|rp)_mean_mag",
    r"(?P<band>(?!m?mag)[a-z]{1,2}[0-9]?)_?(t)?mag(nitude)?( .*)?",
    r"m(ag(nitude)?)?_?(?P<band>[a-z]{1,3})",
    r"(psf)?_?flux_?(?P<band>[a-z]{1,2})(_.*)?",
    r"(?P<band>[jhk])(_m)?",
)
_ERROR = re.compile(
    r"^(e|err|error|sigma|sig|s|unc)_|_(error|err|sigma|unc|msigcom|cmsig)$", re.IGNORECASE
)
_USUAL = {"radial_velocity": "km/s", "pm_ra": "mas/yr", "parallax_error": "mas"}


@dataclass
class MapDraft:
    """The proposed map of a table."""

    path: Path
    columns: dict[str, TableColumn]
    sample: pa.Table
    entries: dict[str, str] = field(default_factory=dict)  # key to TOML value
    notes: dict[str, str] = field(default_factory=dict)  # key to a remark to check
    used: dict[str, str] = field(default_factory=dict)  # column to key
    top: dict[str, str] = field(default_factory=dict)  # keys above the sections
    without_band: set[str] = field(default_factory=set)  # magnitudes whose band is not stated

    @property
    def lacking(self) -> list[str]:
        """The keys that every map needs and for which no column was found."""
        needed = ("star_id", "ra", "dec")
        lacks = [name for name in needed if f"columns.{name}" not in self.entries]
        has_magnitude = any(key.startswith("magnitudes.") for key in self.entries)
        return lacks if has_magnitude else [*lacks, "a magnitude"]

    def as_toml(self) -> str:
        """Return the map as TOML."""
        name = re.sub(r"[^a-z0-9_-]+", "-", self.path.name.lower().split(".")[0]).strip("-")[:29]
        lines = [
            f"# A map proposed for {self.path.name}. Look through it, and check it with",
            f"# starcat sources --check MAP.toml {self.path.name}",
            f'name = "{"my-" if name in source_names() else ""}{name or "mine"}"',
        ]
        lines += [f"{key} = {value}" for key, value in self.top.items()]
        if "epoch" not in self.top:
            lines.append("# epoch = 2000.0  # a guess: the table does not say it; state it here")
        for section in ("columns", "magnitudes", "magnitude_errors", "flags"):
            keys = [key for key in self.entries if key.split(".")[0] == section]
            needed = {"columns": ("columns.star_id", "columns.ra", "columns.dec")}.get(section, ())
            lacks = [key for key in needed if key not in self.entries]
            if section == "magnitudes" and not keys:
                lacks = ["magnitudes.V"]
            if keys or lacks:
                lines += ["", f"[{section}]"]
            for key in lacks:
                lines.append(f'# {key.split(".")[1]} = ""  # no column looks like it: name one')
            for key in keys:
                note = self.notes.get(key, "")
                short = json.dumps(key.split(".", 1)[1])
                short = short[1:-1] if re.fullmatch(r'"[A-Za-z0-9_-]+"', short) else short
                lines.append(f"{short} = {self.entries[key]}{f'  # {note}' if note else ''}")
        rest = [name for name in self.columns if name not in self.used]
        lines += ["", f"# Not used: {', '.join(rest)}" if rest else "# All columns are used."]
        return "\n".join(lines) + "\n"

    def values(self, name: str) -> list[Any]:
        """Return the first values of a column that are not empty."""
        cells = self.sample[name].to_pylist()
        return [cell for cell in cells if cell not in (None, "") and cell == cell]

    def numbers(self, name: str) -> list[float]:
        """Return the first values of a column that are numbers."""
        numbers = []
        for value in self.values(name):
            try:
                numbers.append(float(value))
            except (TypeError, ValueError):
                continue
        return numbers


def draft_map(path: Path) -> MapDraft:
    """Propose a map for a table."""
    parts = table_parts(path) if path.is_dir() else [path]
    if not parts or not parts[0].exists():
        raise SourceMissing(
            "no table there", where=path, hint="give a file, or the folder of a HATS catalog"
        )
    layout = RecordFile(name="table", file_names=(parts[0].name,), layout="table", table=ANY)
    opened = open_table(InputFile(parts[0], layout, "table"))
    rows = next(opened.rows(list(opened.columns)), None)
    names = list(opened.columns)
    sample = rows.table.slice(0, SAMPLE_ROWS) if rows else pa.table({name: [] for name in names})
    draft = MapDraft(path, opened.columns, sample)
    _split_angles(draft)
    for key, name in _guesses(draft):
        _assign(draft, key, name)
    _propose_frame_and_epoch(draft)
    return draft


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", re.sub(r"[\[(].*?[\])]", "", name.lower()))


def _guesses(draft: MapDraft) -> Iterator[tuple[str, str]]:
    """Yield keys with columns that can be their values, the likeliest first."""
    for by_ucd in (True, False):
        for key, ucd, pattern in _RULES:
            for name, column in draft.columns.items():
                base, is_error = _base(name, column)
                ucd_text = column.ucd.lower().removeprefix("stat.error;")
                fits = ucd and ucd_text and re.match(ucd, ucd_text)
                if fits if by_ucd else re.fullmatch(pattern, _plain(base)):
                    error = f"{key.removesuffix('_cosdec')}_error"
                    if not is_error or error in UNITS:
                        yield error if is_error else key, name
        if not by_ucd and not {"columns.ra", "columns.dec"} & draft.entries.keys():
            yield from zip(("ra", "dec"), _galactic_pair(draft), strict=False)
        yield from _magnitudes(draft, by_ucd=by_ucd)
    if not any(key.startswith("magnitudes.") for key in draft.entries):
        yield from _by_unit(draft)
    for short in ("hip_number", "hd_number"):
        if "columns.star_id" not in draft.entries and f"columns.{short}" in draft.entries:
            draft.entries["columns.star_id"] = draft.entries[f"columns.{short}"]
            draft.used |= {name: "star_id" for name, key in draft.used.items() if key == short}


def _galactic_pair(draft: MapDraft) -> tuple[str, ...]:
    """Return the columns l and b, galactic longitude and latitude; without l, b is a magnitude."""
    pairs = (("l", "b"), ("l_deg", "b_deg"), ("l_rad", "b_rad"))
    return next((pair for pair in pairs if draft.columns.keys() >= set(pair)), ())


def _base(name: str, column: TableColumn) -> tuple[str, bool]:
    """Return a column's name without an error prefix or suffix, and whether it is an error."""
    base = _ERROR.sub("", name)
    return base, base != name or column.ucd.lower().startswith("stat.error")


def _magnitudes(draft: MapDraft, *, by_ucd: bool) -> Iterator[tuple[str, str]]:
    for name, column in draft.columns.items():
        if name in _galactic_pair(draft):
            continue
        base, is_error = _base(re.sub(r"\s*[\[(].*?[\])]", "", name), column)
        match = re.search(r"phot\.(?:mag|flux).*em\.[a-z]+\.(?P<band>[A-Za-z]+)$", column.ucd)
        if not by_ucd:
            matches = (re.fullmatch(pattern, base, re.IGNORECASE) for pattern in _BANDS)
            match = next(filter(None, matches), None)
        if match:
            draft.without_band |= set() if match["band"] else {name}
            kind = "magnitude_errors" if is_error else "magnitudes"
            yield f"{kind}.{_band(match['band'] or 'V')}", name


def _by_unit(draft: MapDraft) -> Iterator[tuple[str, str]]:
    """Yield the columns in magnitudes, except errors and colours such as B-V."""
    for name, column in draft.columns.items():
        if column.unit.lower().startswith("mag") and not _base(name, column)[1] and "-" not in name:
            yield f"magnitudes.{_band(name)}", name


def _band(text: str) -> str:
    names = {"vis": "V", "hp": "Hp", "k": "K", "ks": "Ks"}
    if text.lower() in names:
        return names[text.lower()]
    if len(text) == 1:
        return text.upper() if text in "ubvjhg" else text
    return text.upper() if text.lower() in ("bp", "rp", "bt", "vt") else text


def _assign(draft: MapDraft, key: str, name: str) -> None:
    """Make a column the value of a key, if neither is assigned yet."""
    kind, _, band = key.partition(".")
    if name in draft.used:
        return
    if kind == "magnitude_errors" and f"magnitudes.{band}" not in draft.entries:
        return
    if not band:
        key = f"columns.{key}"
    if kind == "epoch":
        scale = next((s for s in ("mjd", "jd", "byear") if s in name.lower()), "jyear")
        draft.top.setdefault("epoch", f'{{ value = {json.dumps(name)}, scale = "{scale}" }}')
        draft.used[name] = "epoch"
        return
    if key in draft.entries and kind == "magnitudes":
        key = f"magnitudes.{re.sub(r'[^A-Za-z0-9]', '', name)}"
    if key in draft.entries:
        return
    draft.used[name] = key.removeprefix("columns.")
    if kind == "flags":
        draft.entries[key], draft.notes[key] = _condition(draft, name), "look at the condition"
        return
    unit, note = _unit(draft, key, name)
    if key == "columns.pm_ra_cosdec" and unit.startswith("s"):
        key = "columns.pm_ra"
        draft.used[name] = "pm_ra"
    quoted = json.dumps(name, ensure_ascii=False)
    draft.entries[key] = f'{{ value = {quoted}, unit = "{unit}" }}' if unit else quoted
    band = "the band is a guess: the table does not state it" if name in draft.without_band else ""
    draft.notes[key] = "; ".join(filter(None, (draft.columns[name].description[:60], note, band)))


def _unit(draft: MapDraft, key: str, name: str) -> tuple[str, str]:
    """Return the unit to state (empty if none is needed), and a remark to check."""
    kind, _, short = key.partition(".")
    target = "mag" if kind.startswith("magnitude") else UNITS.get(short, "")
    stated = draft.columns[name].unit
    if not target or (stated and ":" not in stated and _is_unit(stated)):
        return "", ""
    for text in re.findall(r"[\[(](.+?)[\])]", name):
        if _is_unit(text):
            return text, ""
    for text in name.split("_")[1:]:
        if _is_unit(text) and unit_of_column(text).physical_type in _KINDS:
            return text, ""
    numbers = draft.numbers(name)
    largest = max(map(abs, numbers), default=0.0)
    if short == "ra" and numbers and largest <= 24.0 and not draft.columns[name].is_text:
        return ("rad", "radians?") if largest <= 6.2832 else ("hourangle", "hours?")
    if short == "dec" and numbers and largest <= 1.5708:
        return "rad", "radians?"
    if short in ("ra", "dec"):
        return "", ""
    if target == "mag":
        return ("mmag", "mmag?") if kind == "magnitudes" and largest > 100.0 else ("", "")
    return target.replace(" ", ""), "the unit is a guess"


_KINDS = (
    *("angle", "angular speed", "angular frequency", "frequency", "speed", "unknown"),
    "spectral flux density",
)


def _is_unit(text: str) -> bool:
    try:
        unit_of_column(text)
    except ValueError:
        return False
    return True


def _condition(draft: MapDraft, name: str) -> str:
    """Return a condition on a flag column, with the values that mean yes."""
    column, values = draft.columns[name], draft.values(name)
    shown = name if re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", name) else f'"{name}"'
    if draft.sample[name].type == pa.bool_() or {str(v).lower() for v in values} <= {
        "true",
        "false",
    }:
        return json.dumps(shown)
    if not column.is_text:
        return json.dumps(f"{shown} > 0")
    yes = sorted({v for v in values if re.match(r"[dmvyt1cb]", str(v).lower())})[:8]
    if len(values) < len(draft.sample) or not yes:
        return json.dumps(f"{shown} IS NOT NULL")
    return json.dumps(f"{shown} IN ({', '.join(repr(str(value)) for value in yes)})")


def _split_angles(draft: MapDraft) -> None:
    """Propose angles whose hours or degrees, minutes and seconds are columns, as at the CDS."""
    names = {name.lower(): name for name in draft.columns}
    hours = [names.get(label, "") for label in ("rah", "ram", "ras")]
    if all(hours):
        draft.entries["columns.ra"] = f'{{ value = "{_sum(hours)}", unit = "hourangle" }}'
        draft.used |= dict.fromkeys(hours, "ra")
    degrees = [names.get(label, "") for label in ("ded", "dem", "des")]
    if all(degrees):
        sign = names.get("de-", "")
        text = f"({_sum(degrees)})"
        if sign:
            text = f"CASE WHEN \"{sign}\" = '-' THEN -1 ELSE 1 END * {text}"
            draft.used[sign] = "dec"
        draft.entries["columns.dec"] = f'{{ value = {json.dumps(text)}, unit = "deg" }}'
        draft.used |= dict.fromkeys(degrees, "dec")


def _sum(names: Sequence[str]) -> str:
    return f"{names[0]} + {names[1]} / 60 + {names[2]} / 3600"


def _propose_frame_and_epoch(draft: MapDraft) -> None:
    """Propose frame, equinox and epoch."""
    coordinates = " ".join(name.lower() for name, key in draft.used.items() if key in ("ra", "dec"))
    year = re.search(r"(1[89][0-9]{2}|20[0-9]{2})", coordinates)
    top: dict[str, str] = {}
    if re.search(r"glon|gall|galactic|lii", coordinates):
        top["frame"] = '"galactic"'
    elif set(_galactic_pair(draft)) & {n for n, key in draft.used.items() if key in ("ra", "dec")}:
        top["frame"] = '"galactic"  # a guess, after the names of the columns: look at it'
    elif year and year[1] == "1950":
        top["frame"] = '"FK4"'
    elif year and year[1] != "2000":
        top |= {"frame": '"FK5"', "equinox": f'"J{year[1]}"'}
    elif "fk5" in coordinates:
        top["frame"] = '"FK5"'
    if "epoch" not in draft.top:
        is_gaia = any(name.startswith("phot_g") for name in draft.columns)
        system = "B" if top.get("frame") == '"FK4"' else "J"
        if year:
            top["epoch"] = f'"{system}{year[1]}"  # after the names of the columns: look at it'
        elif is_gaia:
            top["epoch"] = "2016.0  # after the names of the columns: look at it"
    draft.top = {**top, **draft.top}
