"""Hostile specs: presets with extreme numbers, wrong types, odd texts and broken tables in them.

The property: a spec is refused with starcat's own error, or it is valid and can be used. A valid
spec is written as TOML and reads back as itself, and a sky of 80 stars becomes products that are
written, opened by the matcher and tried on two fields, within a gigabyte.
"""

from __future__ import annotations

import copy
import datetime
import math
import resource
import tempfile
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from drafts import chosen
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from starcat.catalog.ingest import Ingested, ingest_catalog
from starcat.database.products.coverage import tiling_gap
from starcat.database.writer import write_products
from starcat.errors import ConfigError, StarcatError
from starcat.pipeline.finish import database_facts, make_products, run_self_test
from starcat.pipeline.report_data import filter_coverages
from starcat.pipeline.specs.build_spec import BuildSpec
from starcat.pipeline.specs.keys import spec_sections, spec_toml, toml_value
from starcat.pipeline.specs.reading import preset_names, read_spec, spec_from_dict
from starcat.progress import no_progress
from starcat.resources import resource_folder

HEADROOM_BYTES = 1 << 30
"""What the use of a spec may allocate, on a sky that needs a few megabytes."""

NUMBERS = [
    *(5e-324, 1e-300, 1e-100, 1e-12, 1e-6, 1e-4, 1e-3, 0.01, 0.1, 0.5, 0.999, 1.0, 1.5, 2.0),
    *(7.0, 30.0, 45.0, 80.0, 90.0, 119.999, 120.0, 150.0, 179.999, 180.0, 360.0, 600.0, 1e4),
    *(1e6, 1e9, 1e15, 1e100, 1e300, 1e308, float("inf"), float("nan"), 0.0),
]

WHOLE_NUMBERS = [
    *(0, 1, 2, 3, 8, 16, 30, 31, 99, 100, 1000, 4096, 10_000, 65_536, 100_000, 1_000_000),
    *(2**31 - 1, 2**31, 2**32, 2**53 + 1, 2**63 - 1, 2**63, 2**64, 10**30, 10**400),
]

TEXTS = [
    *("", " ", "gaia", "sao", "2mass", "gcvs", "G", "remove", "keep", "strict", "rectangular"),
    *("nan", "6.0", "-1", "1.0.0", "01.2.3", "1.0", "../../x", "/etc/passwd", "a" * 64),
    *("\x00", "\n", "\x7f", "\u202e", "\ud7ff", "\u0661\u0662", "\uff11.0.0", "\U0001f52d" * 9),
    *('"', "'", "\\", "[", "]", "{", "#", "${HOME}", "%s", "{0}", "x" * 20_000),
]

OTHERS = [
    *(True, False, [], {}, [[]], ["gaia"], ["hipparcos"], ["sao", "sao"], [1.0], {"a": 1}),
    *(datetime.date(2026, 1, 1), datetime.datetime(2026, 1, 1, 12), datetime.time(1, 2)),
]

numbers = st.one_of(
    st.sampled_from(NUMBERS + [-x for x in NUMBERS]),
    st.sampled_from(WHOLE_NUMBERS + [-n for n in WHOLE_NUMBERS]),
    st.floats(),
    st.integers(-(2**70), 2**70),
)
texts = st.one_of(
    st.sampled_from(TEXTS), st.text(st.characters(exclude_categories=["Cs"]), max_size=40)
)
values = st.one_of(numbers, numbers, texts, st.sampled_from(OTHERS))

PATHS = tuple(tuple(key.path.split(".")) for section in spec_sections() for key in section.keys)
TABLES = tuple(section.path for section in spec_sections() if section.path)

PRESETS = {
    name: tomllib.loads(
        (resource_folder("pipeline/specs/presets") / f"{name}.toml").read_text("utf-8")
    )
    for name in preset_names()
}


@st.composite
def specs(draw: st.DrawFn) -> dict[str, Any]:
    """A preset with one to four changes."""
    content = copy.deepcopy(PRESETS[draw(st.sampled_from(sorted(PRESETS)))])
    for _ in range(draw(st.integers(1, 4))):
        kind = draw(st.sampled_from(["value"] * 8 + ["remove", "unknown", "table", "deep"]))
        if kind == "value":
            put(content, draw(st.sampled_from(PATHS)), draw(values))
        elif kind == "remove":
            remove(content, draw(st.sampled_from(PATHS + TABLES)))
        elif kind == "unknown":
            table = draw(st.sampled_from(((), *TABLES)))
            put(content, (*table, draw(texts)[:200]), draw(values))
        elif kind == "table":
            put(content, draw(st.sampled_from(TABLES)), draw(values))
        else:
            put(content, draw(st.sampled_from(PATHS)), nested(draw(st.integers(1, 60))))
    return content


def put(content: Any, path: tuple[str, ...], value: Any) -> None:
    *tables, name = path
    for table in tables:
        content = content.setdefault(table, {})
        if not isinstance(content, dict):
            return
    content[name] = value


def remove(content: Any, path: tuple[str, ...]) -> None:
    *tables, name = path
    for table in tables:
        content = content.get(table)
        if not isinstance(content, dict):
            return
    content.pop(name, None)


def nested(depth: int) -> list[Any]:
    value: list[Any] = []
    for _ in range(depth):
        value = [value]
    return value


# Refused, or valid ---------------------------------------------------------------------------


def accepted(read: Callable[[], BuildSpec]) -> BuildSpec | None:
    """The spec; None if it is refused with starcat's own error."""
    try:
        return read()
    except ConfigError as error:
        message = str(error)
    assert 0 < len(message) < 4_000
    assert message.isprintable()  # so the message has one line
    return None


@contextmanager
def bounded_memory() -> Iterator[None]:
    """Whoever allocates more than the headroom gets a MemoryError."""
    pages = int(Path("/proc/self/statm").read_text("ascii").split()[0])
    before = resource.getrlimit(resource.RLIMIT_AS)
    limit = pages * resource.getpagesize() + HEADROOM_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


Use = Callable[[BuildSpec], None]


@pytest.fixture(scope="module")
def use(tmp_path_factory: pytest.TempPathFactory, sao_lines: list[bytes]) -> Use:
    """Do with a spec what a build does, on few stars and with few fields."""
    path = tmp_path_factory.mktemp("few") / "sao.dat"
    path.write_bytes(b"".join(sao_lines[::7][:80]))
    catalog = ingest_catalog("sao", [path])

    def use(spec: BuildSpec) -> None:
        with suppress(StarcatError):
            build_from(spec, catalog)

    return use


def few_fields(spec: BuildSpec) -> BuildSpec:
    """The same spec with few fields and frames: many are allowed, and take their time."""
    tiling, test = spec.boresights, spec.self_test
    few = {"count": min(tiling.count, 200)}, {"frames": min(test.frames, 2)}
    sections = tiling.model_copy(update=few[0]), test.model_copy(update=few[1])
    return spec.model_copy(update={"boresights": sections[0], "self_test": sections[1]})


def build_from(spec: BuildSpec, catalog: Ingested) -> None:
    assert repr(spec).isprintable()
    assert spec_from_dict(tomllib.loads(spec_toml(spec)), "again") == spec
    with bounded_memory():
        build_a_little(few_fields(spec), catalog)


def build_a_little(spec: BuildSpec, catalog: Ingested) -> None:
    draft = chosen(catalog.stars, spec)
    draft.rejected = catalog.rejected
    filter_coverages(draft.selected.steps, draft.fields, spec)
    tiling_gap(draft.fields.boresights, spec.camera.camera().radius_rad)
    make_products(draft)
    with tempfile.TemporaryDirectory() as folder:
        write_products(Path(folder), draft.products, database_facts(spec))
        # If a pixel is wider, a tolerance of two pixels covers every star: that takes minutes.
        camera = spec.camera.camera()
        if camera.fov_x_deg <= camera.width_px:
            run_self_test(Path(folder), spec, no_progress)


MANY_BINS = {"radius_deg": 90.0, "angle_bin_deg": 0.1, "separation_bin_deg": 0.001}


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("products", "neighbours"), MANY_BINS),  # 324 million
        (("catalog", "source"), "\x00"),
        (("name",), nested(3_000)),
        *(
            (path, nested(depth))
            for path in (("name",), ("camera",), ("camera", "width_px"), ("odd",))
            for depth in (100, 500)
        ),
    ],
    ids=range(11),
)
def test_what_could_not_be_used_is_refused(path, value):
    content = copy.deepcopy(PRESETS["gaia-12deg"])
    put(content, path, value)
    assert accepted(lambda: spec_from_dict(content, "spec.toml")) is None


def test_a_negative_zero_is_zero():
    content = copy.deepcopy(PRESETS["gaia-12deg"])
    put(content, ("self_test", "noise_px"), -0.0)
    spec = spec_from_dict(content, "spec.toml")
    assert math.copysign(1.0, spec.self_test.noise_px) == 1.0


FEW = settings(max_examples=60, suppress_health_check=list(HealthCheck))
MANY = settings(FEW, max_examples=2_000)
LONG = pytest.param(MANY, marks=[pytest.mark.slow, pytest.mark.timeout(900)])
few_or_many = pytest.mark.parametrize("some", [FEW, LONG], ids=["few", "many"])


@few_or_many
def test_a_spec_is_refused_or_can_be_used(some, use):
    @some
    @given(content=specs())
    def run(content: dict[str, Any]) -> None:
        spec = accepted(lambda: spec_from_dict(content, "spec.toml"))
        if spec is not None:
            use(spec)

    run()


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize("path", PATHS, ids=".".join)
def test_the_least_and_the_most_of_every_number(path, use):
    valid = []
    for value in sorted(
        {sign * x for x in [*NUMBERS, *WHOLE_NUMBERS] if x == x for sign in (1, -1)}
    ):
        content = copy.deepcopy(PRESETS["gaia-12deg"])
        put(content, path, value)
        spec = accepted(partial(spec_from_dict, content, "spec.toml"))
        if spec is not None:
            valid.append(spec)
    for spec in [*valid[:2], *valid[2:][-2:]]:
        use(spec)


# As text -------------------------------------------------------------------------------------

TOKENS = [
    *("= = ", "[", "]", "[[", "\x00", "\n", "'''", '"""', "\\u00zz", "inf", "-nan", "0x", "1_"),
    *("[camera]\n", "camera.width_px = 1\n", "9" * 500, "[" * 2_000, "{a=" * 500, "1e" + "9" * 400),
    *("\u202e", "\ufeff", "1979-05-27T07:32:00Z", "key.key.key = 1\n", "# \x1f\n", "1e"),
]

tokens = st.one_of(
    st.sampled_from(TOKENS).map(str.encode),
    values.filter(lambda v: isinstance(v, (float, str))).map(
        lambda v: toml_value(v).encode("utf-8", "surrogatepass")
    ),
    st.binary(max_size=6),
)
edits = st.lists(st.tuples(st.floats(0.0, 1.0), st.integers(0, 8), tokens), min_size=1, max_size=4)


@few_or_many
def test_a_damaged_file_is_refused_or_can_be_used(some, use, tmp_path):
    path = tmp_path / "spec.toml"

    @some
    @given(name=st.sampled_from(sorted(PRESETS)), changes=edits)
    @example(name="gaia-12deg", changes=[(1.0, 0, b"a = " + b"[" * 2_000)])
    @example(name="gaia-12deg", changes=[(1.0, 0, b"x." * 3_000 + b"y = 1")])
    def run(name: str, changes: list[tuple[float, int, bytes]]) -> None:
        text = (resource_folder("pipeline/specs/presets") / f"{name}.toml").read_bytes()
        for where, removed, inserted in changes:
            place = round(where * len(text))
            text = text[:place] + inserted + text[place + removed :]
        path.write_bytes(text)
        spec = accepted(lambda: read_spec(path))
        if spec is not None:
            use(spec)

    run()


@pytest.mark.parametrize("line", ["big = " + "9" * 5_000, "x" * 9_000 + " = 1"], ids=["int", "key"])
def test_what_python_cannot_read_or_show_is_refused(line, tmp_path):
    """Python itself refuses whole numbers of 4,300 digits; a key is cut in the message."""
    path = tmp_path / "spec.toml"
    path.write_text(line + "\n")
    assert accepted(lambda: read_spec(path)) is None
