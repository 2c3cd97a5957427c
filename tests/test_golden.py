"""Golden builds: what two presets make changes only on purpose, through ``make golden``."""

import json
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent / "builders"))

from golden import GOLDEN, MADE, golden_figures

# Sums of up to a million numbers, each right to its last bit or two.
RELATIVE, ABSOLUTE = 1e-9, 1e-6


@pytest.mark.parametrize(
    ("name", "folder"),
    [("gaia-12deg", "tmp_path"), ("sao-12deg", "excerpts"), (MADE, "made_catalogs")],
)
def test_a_preset_still_makes_the_same_products(name, folder, request):
    catalogs = request.getfixturevalue(folder)
    expected = json.loads((GOLDEN / f"{name}.json").read_text())
    found = json.loads(json.dumps(golden_figures(name, catalogs)))
    assert sorted(found) == sorted(expected)
    for product, figures in expected.items():
        assert found[product]["rows"] == figures["rows"], product
        assert found[product]["exact_sha256"] == figures["exact_sha256"], product
        for column, (count, total) in figures["sums"].items():
            assert found[product]["sums"][column][0] == count, (product, column)
            if count:
                got = found[product]["sums"][column][1]
                assert got == pytest.approx(total, rel=RELATIVE, abs=ABSOLUTE), (product, column)
        for row, before in zip(found[product]["first_rows"], figures["first_rows"], strict=True):
            for column, value in before.items():
                if isinstance(value, float):
                    value = pytest.approx(value, rel=RELATIVE, abs=1e-9)
                assert row[column] == value, column
