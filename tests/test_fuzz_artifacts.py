"""Artifacts that somebody damaged or made up: starcat's own errors, or an answer, and no more."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from starcat.artifact.manifest import manifest_digest
from starcat.artifact.reader import open_artifact
from starcat.artifact.verify import verify_artifact
from starcat.errors import ProductError, StarcatError
from starcat.matcher.database import open_database
from starcat.matcher.matcher import Matcher
from starcat.matcher.methods.table import METHODS
from starcat.simulation.simulate import Noise, simulate_frames
from starcat.storage.digests import file_sha256, json_bytes
from starcat.storage.product_table import PRODUCTS

FEW = settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
MANY = settings(FEW, max_examples=1000)
"""Two targets of so many cases each."""


@pytest.fixture(scope="module")
def copy(small_artifact: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy that every case spoils and puts back."""
    folder = tmp_path_factory.mktemp("fuzz") / small_artifact.name
    return Path(shutil.copytree(small_artifact, folder, copy_function=shutil.copyfile))


@pytest.fixture(scope="module")
def frame(small_artifact: Path) -> Any:
    """A frame that the sound artifact identifies, with false stars in it."""
    database = open_database(small_artifact)
    noise = Noise(0.3, false_stars=2)
    (made,) = simulate_frames(database.directions, database.camera, 1, noise, 8)
    assert Matcher.open(small_artifact).identify(made.centroids_px).status == "identified"
    return made


def identify(artifact: Path, method: str, frame: Any) -> bool:
    """Return whether a frame got an answer; an answer makes sense, whatever the artifact holds."""
    try:
        matcher = Matcher.open(artifact, method)
    except StarcatError:
        return False
    found = matcher.identify(frame.centroids_px)
    assert found.status in ("identified", "no_match", "too_few_stars")
    if found.status == "identified":
        assert math.isclose(np.linalg.norm(found.q_body_from_icrs), 1.0, rel_tol=1e-9)
        assert set(found.star_ids[found.star_index >= 0]) <= set(matcher.database.star_id)
    return True


# Bytes ----------------------------------------------------------------------------------------

FILES = (
    "database.h5",
    "manifest.json",
    "stars.parquet",
    "pairs.parquet",
    "neighbours.parquet",
    "rejected.parquet",
)

Edits = list[tuple[float, int]]
edits = st.lists(
    st.tuples(st.floats(0.0, 1.0, exclude_max=True), st.integers(1, 255)), min_size=1, max_size=8
)
"""Places in a part of a file, as shares of it, and what is added to the byte there."""


def spoilt(data: bytes, changes: Edits, *, front: bool, keep: float) -> bytes:
    """Change some bytes, in the first 4 KB or anywhere, and cut the end off."""
    found = bytearray(data)
    reach = min(4096, len(found)) if front else len(found)
    for share, difference in changes:
        place = int(share * reach)
        found[place] = (found[place] + difference) % 256
    return bytes(found[: max(1, math.ceil(keep * len(found)))])


def check_bytes(artifact: Path, name: str, data: bytes, method: str, frame: Any) -> None:
    path = artifact / name
    before = path.read_bytes()
    path.write_bytes(data)
    try:
        found = verify_artifact(artifact).findings
        assert data == before or name in {finding.file for finding in found}
        identify(artifact, method, frame)
        try:
            opened = open_artifact(artifact)
            for product in opened.products:
                assert opened.table(product).num_columns
        except StarcatError:
            pass
    finally:
        path.write_bytes(before)


def test_changed_bytes_are_found_and_hurt_nobody(copy: Path, frame: Any) -> None:
    run_bytes(FEW, copy, frame)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_a_thousand_changes_of_bytes_hurt_nobody(copy: Path, frame: Any) -> None:
    run_bytes(MANY, copy, frame)


def run_bytes(some: settings, copy: Path, frame: Any) -> None:
    @some
    @given(
        name=st.sampled_from(FILES),
        changes=edits,
        front=st.booleans(),
        keep=st.sampled_from([1.0, 1.0, 1.0, 0.999, 0.5, 0.0]),
        method=st.sampled_from(sorted(METHODS)),
    )
    def run(name: str, changes: Edits, front: bool, keep: float, method: str) -> None:
        data = spoilt((copy / name).read_bytes(), changes, front=front, keep=keep)
        check_bytes(copy, name, data, method, frame)

    run()


# Structures of HDF5 that no build writes ----------------------------------------------------------

Structure = Callable[[h5py.Group, str, Path], object]
"""Put something else at a name of a group; the path is of a whole database beside the file."""


def external_link(group: h5py.Group, name: str, other: Path) -> None:
    group[name] = h5py.ExternalLink(str(other), f"{group.name}/{name}")


def soft_link(group: h5py.Group, name: str, other: Path) -> None:
    product = group.name.strip("/")
    group[name] = h5py.SoftLink(f"/{product or 'pairs'}")


def virtual(group: h5py.Group, name: str, other: Path) -> None:
    source = h5py.VirtualSource(str(other), "stars/mag", (10,))
    layout = h5py.VirtualLayout((10,), "f8")
    layout[:] = source
    group.create_virtual_dataset(name, layout)


def in_a_raw_file(group: h5py.Group, name: str, other: Path) -> None:
    group.create_dataset(name, (10,), "f8", external=[(str(other), 0, 80)])


def without_storage(shape: Any, dtype: Any = "f8", **options: Any) -> Structure:
    def make(group: h5py.Group, name: str, other: Path) -> None:
        group.create_dataset(name, shape, dtype, **options)

    return make


def holding(values: Any) -> Structure:
    def make(group: h5py.Group, name: str, other: Path) -> None:
        group[name] = values

    return make


def in_a_circle(group: h5py.Group, name: str, other: Path) -> None:
    group[name] = group["/"]


STRUCTURES: dict[str, Structure] = {
    "external link": external_link,
    "soft link": soft_link,
    "dangling link": lambda group, name, other: group.__setitem__(name, h5py.SoftLink("/nowhere")),
    "virtual": virtual,
    "raw file": in_a_raw_file,
    "group": lambda group, name, other: group.create_group(name),
    "circle": in_a_circle,
    "4e9 rows": without_storage((4_000_000_000,)),
    "2e18 rows": without_storage((2_000_000_000_000_000_000,)),
    "endless": without_storage((100,), chunks=(10,), maxshape=(None,)),
    "4e9 rows in chunks": without_storage((4_000_000_000,), chunks=(1000,)),
    "nothing": without_storage((0,)),
    "no shape": lambda group, name, other: group.__setitem__(name, h5py.Empty("f8")),
    "one number": holding(3.0),
    "a table": holding(np.zeros((10, 2))),
    "texts": holding(["a", "b"]),
    "records": holding(np.zeros(10, [("a", "i4"), ("b", "f8")])),
    "truth values": holding(np.zeros(10, bool)),
    "complex": holding(np.zeros(10, complex)),
    "other end first": holding(np.zeros(10, ">i4")),
    "a type": lambda group, name, other: group.__setitem__(name, np.dtype("i4")),
    "references": without_storage((10,), h5py.ref_dtype),
    "opaque": holding(np.zeros(10, "V7")),
    "other rows": holding(np.arange(10)),
    "other numbers": holding(np.linspace(0.0, 1.0, 10)),
}

DATASETS = [(product, name) for product, layout in PRODUCTS.items() for name in layout.datasets]
USED = sorted({name for method in METHODS.values() for name in ("stars", *method.products)})


def spoil_database(artifact: Path, change: Callable[[h5py.File], object]) -> bytes:
    """Change the database, make all digests right again, and return how it was."""
    path = artifact / "database.h5"
    before = path.read_bytes()
    with h5py.File(path, "r+") as file:
        change(file)
    seal(artifact)
    return before


def seal(artifact: Path) -> None:
    manifest = json.loads((artifact / "manifest.json").read_bytes())
    path = artifact / "database.h5"
    held = {"bytes": path.stat().st_size, "sha256": file_sha256(path)}
    manifest["files"]["database.h5"] = held
    manifest["manifest_sha256"] = manifest_digest(manifest)
    (artifact / "manifest.json").write_bytes(json_bytes(manifest))


def restore(artifact: Path, before: bytes) -> None:
    (artifact / "database.h5").write_bytes(before)
    seal(artifact)


def test_a_name_that_is_no_text_is_told(copy: Path) -> None:
    text = h5py.string_dtype("utf-8")
    before = spoil_database(copy, lambda file: file.attrs.create("name", b"sm\xff", dtype=text))
    try:
        with pytest.raises(ProductError, match="not a readable starcat database"):
            open_database(copy)
    finally:
        restore(copy, before)


def put(product: str, name: str, structure: str, other: Path) -> Callable[[h5py.File], object]:
    def change(file: h5py.File) -> None:
        group = file[product] if name else file["/"]
        del group[name or product]
        STRUCTURES[structure](group, name or product, other)

    return change


@pytest.mark.parametrize("structure", STRUCTURES)
@pytest.mark.parametrize(
    ("product", "name"),
    [("stars", "mag"), ("pairs", "i"), ("pairs", "kvector_counts"), ("pairs", "")],
)
def test_a_structure_that_no_build_writes_is_refused(
    structure, product, name, copy, small_artifact
):
    other = small_artifact / "database.h5"
    before = spoil_database(copy, put(product, name, structure, other))
    try:
        with pytest.raises(ProductError) as caught:
            Matcher.open(copy, "pairs")
        assert verify_artifact(copy).findings
    finally:
        restore(copy, before)
    text = str(caught.value)
    assert text.count(str(copy / "database.h5")) == 1
    assert f"{product}/{name}" in text if name else product in text
    assert len(text) < 500


@pytest.mark.parametrize("link", ["external link", "virtual", "raw file"])
def test_no_other_file_is_read(link: str, copy: Path, small_artifact: Path) -> None:
    """The answer is the same whether the other file has the right values or is not there."""
    texts = set()
    for other in (small_artifact / "database.h5", copy / "nowhere.h5"):
        before = spoil_database(copy, put("stars", "mag", link, other))
        try:
            with pytest.raises(ProductError) as caught:
                open_database(copy)
            texts.add(str(caught.value))
        finally:
            restore(copy, before)
    assert len(texts) == 1


def test_made_up_databases_hurt_nobody(copy: Path, frame: Any, small_artifact: Path) -> None:
    run_structures(FEW, copy, frame, small_artifact / "database.h5")


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_a_thousand_made_up_databases_hurt_nobody(copy, frame, small_artifact):
    run_structures(MANY, copy, frame, small_artifact / "database.h5")


VALUES: dict[str, list[Any]] = {
    "i": [-1, -(2**31), 2**31 - 1, 500, 0],
    "u": [65_535, 500, 0],
    "f": [math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324, -1.0, 0.0],
    "S": [b"\xff\xfe", b"", b"SAO 1"],
}
NUMBERS: list[Any] = [
    0, -1, 5e-324, 1e308, math.nan, math.inf, 2**63 - 1, "text", [1.0, 2.0], b"\xff",
    h5py.Empty("f8"),
]  # fmt: skip


def run_structures(some: settings, copy: Path, frame: Any, other: Path) -> None:
    @some
    @given(data=st.data())
    def run(data: st.DataObject) -> None:
        product = data.draw(st.sampled_from(USED))
        names = PRODUCTS[product].datasets
        kind = data.draw(st.sampled_from(["structure", "values", "values", "attribute"]))
        if kind == "structure":
            name = data.draw(st.sampled_from(names))
            change = put(product, name, data.draw(st.sampled_from(sorted(STRUCTURES))), other)
        elif kind == "values":
            places = data.draw(
                st.lists(
                    st.tuples(
                        st.sampled_from(names), st.floats(0.0, 1.0, exclude_max=True),
                        st.integers(0, 99), st.integers(1, 40),
                    ),
                    min_size=1, max_size=3,
                )
            )  # fmt: skip
            change = with_values(product, places)
        else:
            where = data.draw(st.sampled_from(["/", product]))
            change = with_attribute(where, data.draw(st.integers(0, 9)), data.draw(
                st.sampled_from(range(len(NUMBERS)))
            ))  # fmt: skip
        before = spoil_database(copy, change)
        try:
            able = [name for name, m in METHODS.items() if product in ("stars", *m.products)]
            identify(copy, data.draw(st.sampled_from(able)), frame)
            if kind == "structure":
                verify_artifact(copy)
        finally:
            restore(copy, before)

    run()


def with_values(
    product: str, places: list[tuple[str, float, int, int]]
) -> Callable[[h5py.File], object]:
    def change(file: h5py.File) -> None:
        for name, share, choice, count in places:
            dataset = file[product][name]
            values = VALUES[dataset.dtype.kind]
            first = int(share * len(dataset))
            with np.errstate(over="ignore", under="ignore"):
                value = np.array(values[choice % len(values)]).astype(dataset.dtype)
            dataset[first : first + count] = value

    return change


def with_attribute(where: str, place: int, choice: int) -> Callable[[h5py.File], object]:
    def change(file: h5py.File) -> None:
        names = sorted(file[where].attrs)
        file[where].attrs[names[place % len(names)]] = NUMBERS[choice]

    return change
