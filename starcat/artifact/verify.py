"""Verification of a database: every file, every product, and what they say of each other.

All problems are collected. Content is read only from files whose digest is that of the
manifest, since a damaged file is not to be trusted to the libraries that would parse it.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from starcat.artifact.checks import (
    REFERENCE_CHECKS,
    TABLE_CHECKS,
    HeldProduct,
    columns_follow_the_schema,
    group_problems,
    index_problems,
    root_problems,
)
from starcat.artifact.manifest import DATABASE_NAME, MANIFEST_NAME, manifest_digest, read_manifest
from starcat.artifact.reader import DatabaseFolder
from starcat.errors import ProductError, StarcatError, no_database
from starcat.products.table import PRODUCTS
from starcat.specs.epoch import middle_of
from starcat.stars.star_table import directions_of
from starcat.stars.verdict import Reason
from starcat.storage.digests import file_sha256, json_bytes
from starcat.storage.hdf5 import own_group

T = TypeVar("T")

_NOT_CHECKED = "Nothing else was checked, as nothing else says what the files should be"

MAX_NAMED = 5
"""Findings that an error message repeats."""


@dataclass(frozen=True)
class Finding:
    """One problem of a database."""

    file: str  # path within the database
    # product that the file holds; ``database`` for the HDF5 file as a whole, empty where there is
    # none
    product: str
    problem: str  # what was found and what was expected

    def __str__(self) -> str:
        product = f" ({self.product})" if self.product else ""
        return f"{self.file}{product}: {self.problem}"


@dataclass(frozen=True)
class Verification:
    """What a verification found."""

    folder: Path  # the database
    checks: int  # number of checks that were done
    findings: tuple[Finding, ...]  # every problem; none for a sound database

    def __repr__(self) -> str:
        found = len(self.findings)
        return f"<Verification {self.folder.name}: {self.checks:,} checks, {found} findings>"

    def as_dict(self) -> dict[str, Any]:
        """Return the result as plain values."""
        findings = [asdict(finding) for finding in self.findings]
        return {"folder": str(self.folder), "checks": self.checks, "findings": findings}


def verify_artifact(folder: Path) -> Verification:
    """Check files, schemas, contents, orders, indices, references and counts of a database."""
    if not folder.is_dir():
        raise no_database(folder)
    log = _Log()
    # Held against a damaged manifest, files that are whole would get the blame.
    if log.run(MANIFEST_NAME, "", _manifest_problems, folder / MANIFEST_NAME):
        manifest = log.get(MANIFEST_NAME, "", read_manifest, folder)
        if manifest:
            log.get(MANIFEST_NAME, "", _check_all, DatabaseFolder(folder, manifest), log)
    return Verification(folder, log.checks, tuple(log.findings))


def check_artifact(folder: Path) -> DatabaseFolder:
    """Check that a database is whole."""
    found = verify_artifact(folder).findings
    if found:
        raise ProductError(
            f"{folder}: {first_of(found)}. Build the database again, or fetch it again",
            product=found[0].product or None,
            path=folder / found[0].file,
        )
    return DatabaseFolder(folder, read_manifest(folder))


def first_of(findings: Sequence[Finding]) -> str:
    """Return the first findings as one line, and how many more there are."""
    more = f"; and {len(findings) - MAX_NAMED} more" if len(findings) > MAX_NAMED else ""
    return "; ".join(str(finding) for finding in findings[:MAX_NAMED]) + more


@dataclass
class _Log:
    """Runs checks, counts them and keeps what they find; nothing that a check raises escapes."""

    checks: int = 0
    findings: list[Finding] = field(default_factory=list)

    def get(self, file: str, product: str, function: Callable[..., T], *args: Any) -> T | None:
        """Return what a function returns; None, and a finding, where it raises."""
        self.checks += 1
        try:
            return function(*args)
        except StarcatError as error:
            self.findings.append(Finding(file, product, str(error)))
        except Exception as error:  # whatever damage makes a library raise
            why = f"cannot be read: {type(error).__name__}: {error}"
            self.findings.append(Finding(file, product, why))
        return None

    def run(self, file: str, product: str, check: Callable[..., Iterable[str]], *args: Any) -> bool:
        """Keep the problems that a check yields, and return whether there were none."""
        problems = self.get(file, product, lambda: list(check(*args)))
        self.findings += [Finding(file, product, problem) for problem in problems or ()]
        return problems == []


def _manifest_problems(path: Path) -> Iterator[str]:
    if not path.is_file():
        yield f"missing. {_NOT_CHECKED}"
        return
    data = path.read_bytes()
    try:
        manifest = json.loads(data)
        if data != json_bytes(manifest):
            yield f"changed since it was built: not as starcat writes it. {_NOT_CHECKED}"
        elif manifest["manifest_sha256"] != manifest_digest(manifest):
            yield f"changed since it was built: manifest_sha256 is not its digest. {_NOT_CHECKED}"
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        yield f"not a manifest of starcat ({type(error).__name__}: {error}). {_NOT_CHECKED}"


def _check_all(artifact: DatabaseFolder, log: _Log) -> None:
    damaged = _check_files(artifact, log)
    held = _check_products(artifact, damaged, log)
    log.run(MANIFEST_NAME, "", _count_problems, artifact.manifest, held)
    if DATABASE_NAME not in damaged:
        log.get(DATABASE_NAME, "database", _check_database, artifact, held, log)


def _check_files(artifact: DatabaseFolder, log: _Log) -> set[str]:
    """Return the names of the files that are not as the manifest says."""
    folder, listed = artifact.folder, artifact.manifest["files"]
    damaged = {
        name
        for name, facts in listed.items()
        if not log.run(name, _product_of(name), _file_problems, folder / name, facts)
    }
    log.checks += 1
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        is_folder = path.is_dir() and not path.is_symlink()
        if not is_folder and name not in listed and name != MANIFEST_NAME:
            log.findings.append(Finding(name, _product_of(name), "not listed in the manifest"))
    return damaged


def _product_of(name: str) -> str:
    path = Path(name)
    if path.name == DATABASE_NAME:
        return "database"
    return path.stem if path.suffix == ".parquet" else ""


def _file_problems(path: Path, facts: dict[str, Any]) -> Iterator[str]:
    if not path.is_file():
        yield "missing; the manifest lists it"
        return
    size = path.stat().st_size
    if size != facts["bytes"]:
        yield f"{size} bytes; the manifest says {facts['bytes']}"
        return
    digest = file_sha256(path)
    if digest != facts["sha256"]:
        yield (
            f"changed since it was built: its sha256 begins with {digest[:12]}; the manifest says "
            f"{facts['sha256'][:12]}"
        )


def _check_products(
    artifact: DatabaseFolder, damaged: set[str], log: _Log
) -> dict[str, HeldProduct]:
    """Return the products whose columns follow their schemas, after checking what is in them."""
    sound: dict[str, HeldProduct] = {}
    stars: pa.Table | None = None
    for product in sorted(artifact.products, key=lambda name: name != "stars"):
        file = artifact.manifest["products"][product]["parquet"]
        if file in damaged:
            continue
        held = log.get(file, product, _hold, artifact, product, stars)
        if held is None or not log.run(file, product, columns_follow_the_schema, held):
            continue
        sound[product] = held
        for check in TABLE_CHECKS:
            log.run(file, product, check, held)
        if product == "stars":
            stars = held.table
        elif "stars" in sound:
            all(log.run(file, product, check, held) for check in REFERENCE_CHECKS)
    return sound


def _hold(artifact: DatabaseFolder, product: str, stars: pa.Table | None) -> HeldProduct:
    facts = artifact.manifest["products"][product]
    directions = np.empty((0, 3)) if stars is None else directions_of(stars)
    return HeldProduct(artifact.table(product), artifact.schema(product), facts, directions, stars)


def _rejected_of(
    source: dict[str, Any], manifest: dict[str, Any], held: dict[str, HeldProduct]
) -> pa.ChunkedArray:
    """Return the reasons of the rejected records of a catalog, one of several or the only one."""
    table = held["rejected"].table
    if [other["role"] for other in manifest["sources"]].count("stars") > 1:
        table = table.filter(pc.equal(table["catalog"], source["source"]))
    return table["reason"]


def _count_problems(manifest: dict[str, Any], held: dict[str, HeldProduct]) -> Iterator[str]:
    """Yield where the counts of sources, products and spec do not add up."""
    spec, products = manifest["spec"], manifest["products"]
    for key in ("name", "version", "epoch_jyear"):
        said = middle_of(spec[key]) if key == "epoch_jyear" else spec[key]
        if manifest[key] != said:
            yield f"{key} is {manifest[key]!r}; its spec says {said!r}"
    if [source["role"] for source in manifest["sources"]][:1] != ["stars"]:
        yield "sources: no star catalog"
    stars = [source for source in manifest["sources"] if source["role"] == "stars"]
    all_kept = sum(source["kept"] for source in stars)
    if stars and all_kept != products["stars"]["rows"]:
        names = " and ".join(source["source"] for source in stars)
        yield f"{names}: {all_kept} kept, but {products['stars']['rows']} stars"
    for source in manifest["sources"]:
        read, kept = source["rows_read"], source["kept"]
        rejected = sum(source["rejected"].values())
        in_files = sum(file["rows"] for file in source["files"])
        if not read == kept + rejected == in_files:
            yield (
                f"{source['source']}: {read} rows read, {in_files} in its files, {kept} kept and "
                f"{rejected} rejected"
            )
        if source["role"] == "stars" and "rejected" in held:
            counts = pc.value_counts(_rejected_of(source, manifest, held)).to_pylist()
            held_rows = {entry["values"]: entry["counts"] for entry in counts}
            listed = dict(source["rejected"])
            # Records beyond a read limit are counted and not listed; no other spec counts any.
            if spec["catalog"].get("read_limit_mag") is not None:
                listed.pop(Reason.beyond_read_limit.name, None)
            if held_rows != listed:
                yield (
                    f"{source['source']}: rejected {listed}, but the product rejected holds "
                    f"{held_rows}"
                )
        kind = PRODUCTS.get(source["role"])
        if kind is not None and kind.joined is not None and kind.name in held:
            count_of, have = kind.joined
            name, joined = source["source"], source.get("joined")
            if (found := count_of(held[kind.name].table, name)) != joined:
                yield f"{name}: {joined} stars {have}, but the product {kind.name} holds {found}"
        elif source["role"] == "motions" and "motions" not in products:
            yield f"{source['source']}: motions are from it, but there is no product motions"
    for product, facts in products.items():
        if facts["parquet"] not in manifest["files"]:
            yield f"product {product}: {facts['parquet']} is not among the files"
    fields = spec["boresights"]["count"]
    if products["boresights"]["rows"] != fields:
        yield f"{products['boresights']['rows']} boresights; the spec says {fields}"


def _check_database(artifact: DatabaseFolder, held: dict[str, HeldProduct], log: _Log) -> None:
    stars = artifact.manifest["products"]["stars"]["rows"]
    with h5py.File(artifact.folder / DATABASE_NAME, "r") as file:
        log.run(DATABASE_NAME, "database", root_problems, file, artifact.manifest)
        for name, product in held.items():
            group = log.get(DATABASE_NAME, name, own_group, file, name) if name in file else None
            if group is not None:
                for check in (group_problems, index_problems):
                    parts = (group, product.table, product.schema, stars)
                    log.run(DATABASE_NAME, name, check, *parts)
