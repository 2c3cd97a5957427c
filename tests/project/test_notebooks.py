"""The notebooks of docs/notebooks run from their first cell to their last."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from programs import printed_by

FOLDER = Path(__file__).parents[2] / "docs" / "notebooks"
PRINTED = {
    "build_and_explore": ["<Database notebook-1.0.0", "too_faint", "guide stars"],
    "identify_a_night": ["of 60 frames identified", "median error", "'tracking', 'tracking'"],
    "query_catalogs": ["482176", "designation", "double +152", "separation_arcsec"],
}
"""Expressions that are in what a notebook prints."""


def test_every_notebook_is_listed_and_has_words_before_its_cells() -> None:
    assert {path.stem for path in FOLDER.glob("*.py")} == PRINTED.keys()
    page = (FOLDER.parent / "notebooks.md").read_text(encoding="utf-8")
    for name in PRINTED:
        text = (FOLDER / f"{name}.py").read_text(encoding="utf-8")
        assert text.startswith("# %% [markdown]\n# # ")
        assert text.count("# %% [markdown]\n") == text.count("# %%\n") >= 3
        assert f"notebooks/{name}.py" in page


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize("name", PRINTED)
def test_a_notebook_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MPLBACKEND", "Agg")
    printed = printed_by("-W", "error::DeprecationWarning", FOLDER / f"{name}.py", cwd=tmp_path)
    for words in PRINTED[name]:
        assert re.search(words, printed), (words, printed)
