"""Damaged and forged databases: each gives one of starcat's own errors, or an answer."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from database_copies import copied, seal
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from starcat.database.products.layouts import datasets_of
from starcat.database.reader import open_database_folder
from starcat.database.verify import verify
from starcat.errors import ProductError, StarcatError
from starcat.matcher.database import open_database
from starcat.matcher.matcher import Matcher
from starcat.matcher.methods.table import METHODS
from starcat.pipeline.simulation.simulate import Noise, simulate_frames

FEW = settings(max_examples=12, suppress_health_check=[HealthCheck.function_scoped_fixture])
MANY = settings(FEW, max_examples=1000)
LONG = pytest.param(MANY, marks=[pytest.mark.slow, pytest.mark.timeout(3600)])
few_or_many = pytest.mark.parametrize("some", [FEW, LONG], ids=["few", "many"])


@pytest.fixture(scope="module")
def copy(small_database: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy that every case spoils and puts back."""
    return copied(small_database, tmp_path_factory.mktemp("fuzz"))


@pytest.fixture(scope="module")
def frame(small_database: Path) -> Any:
    """A frame that the sound database identifies, with false stars in it."""
    database = open_database(small_database)
    noise = Noise(0.3, false_stars=2)
    (made,) = simulate_frames(database.directions, database.camera, 1, noise, 8)
    assert Matcher.open(small_database).identify(made.centroids_px).status == "identified"
    return made


def identify(database: Path, method: str, frame: Any) -> bool:
    """Return whether a frame got an answer; every answer makes sense, for any database."""
    try:
        matcher = Matcher.open(database, method)
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
"""Places in a part of a file, as fractions of its length, and the number added to each byte."""


def spoilt(data: bytes, changes: Edits, *, front: bool, keep: float) -> bytes:
    """Change some bytes, in the first 4 KB or anywhere, and cut the end off."""
    found = bytearray(data)
    reach = min(4096, len(found)) if front else len(found)
    for share, difference in changes:
        place = int(share * reach)
        found[place] = (found[place] + difference) % 256
    return bytes(found[: max(1, math.ceil(keep * len(found)))])


def check_bytes(database: Path, name: str, data: bytes, method: str, frame: Any) -> None:
    path = database / name
    before = path.read_bytes()
    path.write_bytes(data)
    try:
        found = verify(database).findings
        assert data == before or name in {finding.file for finding in found}
        identify(database, method, frame)
        with suppress(StarcatError):
            opened = open_database_folder(database)
            for product in opened.products:
                assert opened.table(product).num_columns
    finally:
        path.write_bytes(before)


@few_or_many
def test_changed_bytes_are_found_and_do_no_harm(some, copy, frame):
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
"""Replace a member of a group; the path leads to a complete database next to the file."""


def virtual(group: h5py.Group, name: str, other: Path) -> None:
    layout = h5py.VirtualLayout((10,), "f8")
    layout[:] = h5py.VirtualSource(str(other), "stars/mag", (10,))
    group.create_virtual_dataset(name, layout)


def in_a_raw_file(group: h5py.Group, name: str, other: Path) -> None:
    group.create_dataset(name, (10,), "f8", external=[(str(other), 0, 80)])


def without_storage(shape: Any, dtype: Any = "f8", **options: Any) -> Structure:
    return lambda group, name, other: group.create_dataset(name, shape, dtype, **options)


def holding(value: Any) -> Structure:
    return lambda group, name, other: group.__setitem__(name, value)


def linking(make: Callable[[h5py.Group, str, Path], Any]) -> Structure:
    return lambda group, name, other: group.__setitem__(name, make(group, name, other))


STRUCTURES: dict[str, Structure] = {
    "external link": linking(lambda g, name, o: h5py.ExternalLink(str(o), f"{g.name}/{name}")),
    "soft link": linking(lambda g, name, o: h5py.SoftLink(f"/{g.name.strip('/') or 'pairs'}")),
    "dangling link": holding(h5py.SoftLink("/nowhere")),
    "virtual": virtual,
    "raw file": in_a_raw_file,
    "group": lambda group, name, other: group.create_group(name),
    "circle": linking(lambda g, name, o: g["/"]),
    "4e9 rows": without_storage((4_000_000_000,)),
    "2e18 rows": without_storage((2_000_000_000_000_000_000,)),
    "endless": without_storage((100,), chunks=(10,), maxshape=(None,)),
    "4e9 rows in chunks": without_storage((4_000_000_000,), chunks=(1000,)),
    "nothing": without_storage((0,)),
    "no shape": holding(h5py.Empty("f8")),
    "one number": holding(3.0),
    "a table": holding(np.zeros((10, 2))),
    "texts": holding(["a", "b"]),
    "records": holding(np.zeros(10, [("a", "i4"), ("b", "f8")])),
    "truth values": holding(np.zeros(10, bool)),
    "complex": holding(np.zeros(10, complex)),
    "other end first": holding(np.zeros(10, ">i4")),
    "a type": holding(np.dtype("i4")),
    "references": without_storage((10,), h5py.ref_dtype),
    "opaque": holding(np.zeros(10, "V7")),
    "other rows": holding(np.arange(10)),
    "other numbers": holding(np.linspace(0.0, 1.0, 10)),
}

USED = sorted({name for method in METHODS.values() for name in ("stars", *method.products)})


@contextmanager
def spoilt_database(database: Path, change: Callable[[h5py.File], object]) -> Iterator[None]:
    """Change the database and make all digests right again; put it back in the end."""
    path = database / "database.h5"
    before = path.read_bytes()
    with h5py.File(path, "r+") as file:
        change(file)
    seal(database)
    try:
        yield
    finally:
        path.write_bytes(before)
        seal(database)


def put(product: str, name: str, structure: str, other: Path) -> Callable[[h5py.File], object]:
    def change(file: h5py.File) -> None:
        group = file[product] if name else file["/"]
        del group[name or product]
        STRUCTURES[structure](group, name or product, other)

    return change


@pytest.mark.parametrize("structure", STRUCTURES)
@pytest.mark.parametrize(
    ("product", "name"),
    [
        ("pairs", "i"),
        ("pairs", ""),
        pytest.param("stars", "mag", marks=pytest.mark.slow),
        pytest.param("pairs", "kvector_counts", marks=pytest.mark.slow),
    ],
)
def test_a_structure_that_no_build_writes_is_refused(
    structure, product, name, copy, small_database
):
    with spoilt_database(copy, put(product, name, structure, small_database / "database.h5")):
        with pytest.raises(ProductError) as caught:
            Matcher.open(copy, "pairs")
        assert verify(copy).findings
    text = str(caught.value)
    assert text.count(str(copy / "database.h5")) == 1
    assert f"{product}/{name}" in text if name else product in text
    assert len(text) < 500


@pytest.mark.parametrize("link", ["external link", "virtual", "raw file"])
def test_no_other_file_is_read(link, copy, small_database):
    """The answer is the same whether the other file has the right values or is not there."""
    texts = set()
    for other in (small_database / "database.h5", copy / "nowhere.h5"):
        with spoilt_database(copy, put("stars", "mag", link, other)):
            with pytest.raises(ProductError) as caught:
                open_database(copy)
            texts.add(str(caught.value))
    assert len(texts) == 1


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


@few_or_many
def test_made_up_databases_do_no_harm(some, copy, frame, small_database):
    other = small_database / "database.h5"

    @some
    @given(data=st.data())
    def run(data: st.DataObject) -> None:
        product = data.draw(st.sampled_from(USED))
        names = datasets_of(product)
        kind = data.draw(st.sampled_from(["structure", "values", "values", "attribute"]))
        if kind == "structure":
            name = data.draw(st.sampled_from(names))
            change = put(product, name, data.draw(st.sampled_from(sorted(STRUCTURES))), other)
        elif kind == "values":
            share = st.floats(0.0, 1.0, exclude_max=True)
            place = st.tuples(st.sampled_from(names), share, st.integers(0, 99), st.integers(1, 40))
            change = with_values(product, data.draw(st.lists(place, min_size=1, max_size=3)))
        else:
            where = data.draw(st.sampled_from(["/", product]))
            number = data.draw(st.sampled_from(range(len(NUMBERS))))
            change = with_attribute(where, data.draw(st.integers(0, 9)), number)
        able = [name for name, m in METHODS.items() if product in ("stars", *m.products)]
        with spoilt_database(copy, change):
            identify(copy, data.draw(st.sampled_from(able)), frame)
            if kind == "structure":
                verify(copy)

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
