"""Golden builds: what two presets make changes only on purpose, through ``make golden``."""

import json

import pytest
from golden import GOLDEN, MADE, golden_build, golden_figures

# Sums of up to a million numbers, each right to its last bit or two.
RELATIVE, ABSOLUTE = 1e-9, 1e-6
# The circumradius of three stars nearly in line has the errors of their small area.
RELATIVE_OF = {"circumradius_rad": 1e-7}


COUNTS = {
    "sao-12deg": (
        [(15_935, {"too_faint": 10_832, "double": 112, "variable": 32}, 4_959), (9_933, 9_928)],
        [5_103, 4_991, 4_959],
    ),
    MADE: (
        [(8_647, {"too_faint": 3_468, "double": 143, "variable": 30}, 5_006), (8_647, 8_642)],
        [5_179, 5_036, 5_006],
    ),
}
"""Records read, rejected and kept of SAO, read and kept of Hipparcos; stars after each filter."""


@pytest.mark.parametrize(
    ("name", "folder"),
    [
        pytest.param("gaia-12deg", "tmp_path", marks=pytest.mark.slow),
        pytest.param("sao-12deg", "excerpts", marks=pytest.mark.real),
        pytest.param(MADE, "made_catalogs", marks=pytest.mark.slow),
    ],
)
def test_a_preset_still_makes_the_same_products(name, folder, request, tmp_path_factory):
    built = golden_build(name, request.getfixturevalue(folder), tmp_path_factory.mktemp("golden"))
    assert built.rates[0].identified_share >= 0.99
    assert not built.problems
    for source in built.manifest["sources"]:
        assert source["rows_read"] == source["kept"] + sum(source["rejected"].values())
        assert source["rows_read"] == sum(file["rows"] for file in source["files"])
    if name in COUNTS:
        sao, hipparcos = built.manifest["sources"]
        found = [
            (sao["rows_read"], sao["rejected"], sao["kept"]),
            (hipparcos["rows_read"], hipparcos["kept"]),
        ]
        assert (found, [step.stars for step in built.filters]) == COUNTS[name]
    check_figures(name, json.loads(json.dumps(golden_figures(built.folder))))


def check_figures(name, found):
    expected = json.loads((GOLDEN / f"{name}.json").read_text())
    assert sorted(found) == sorted(expected)
    for product, figures in expected.items():
        assert found[product]["rows"] == figures["rows"], product
        assert found[product]["exact_sha256"] == figures["exact_sha256"], product
        for column, (count, total) in figures["sums"].items():
            assert found[product]["sums"][column][0] == count, (product, column)
            if count:
                got = found[product]["sums"][column][1]
                relative = RELATIVE_OF.get(column, RELATIVE)
                assert got == pytest.approx(total, rel=relative, abs=ABSOLUTE), (product, column)
        for row, before in zip(found[product]["first_rows"], figures["first_rows"], strict=True):
            for column, value in before.items():
                if isinstance(value, float):
                    value = pytest.approx(value, rel=RELATIVE, abs=1e-9)
                assert row[column] == value, column
