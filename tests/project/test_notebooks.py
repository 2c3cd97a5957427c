"""Pages of notebooks have the cells of the notebooks, and show what the cells print and draw.

``test_docs.py`` runs the pages, as it runs all pages.
"""

from __future__ import annotations

import re
from pathlib import Path

import page_outputs
import pytest

DOCS = Path(__file__).parents[2] / "docs"
NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.py"))


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_the_page_of_a_notebook_has_its_cells(notebook: Path) -> None:
    text = notebook.read_text(encoding="utf-8")
    assert text.startswith("# %% [markdown]\n# # ")
    assert text.count("# %% [markdown]\n") == text.count("# %%\n") >= 3
    assert f"notebooks/{notebook.name}" in (DOCS / "notebooks.md").read_text(encoding="utf-8")
    page = (DOCS / f"notebook-{notebook.stem}.md").read_text(encoding="utf-8")
    without = re.sub(r"\n```text\n.*?^```\n", "", page, flags=re.DOTALL | re.MULTILINE)
    without = re.sub(r"\n!\[.*\]\(.*\)\n", "", without)
    assert without == page_outputs.notebook_page(text), "run make docs-outputs"


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_the_page_of_a_notebook_shows_outputs_and_figures(notebook: Path) -> None:
    page = (DOCS / f"notebook-{notebook.stem}.md").read_text(encoding="utf-8")
    assert all(step.shown for step in page_outputs.steps_of(page) if "print(" in step.text)
    assert page.count("](figures/") >= 1


def test_pictures_of_the_documentation_are_small() -> None:
    for picture in (DOCS / "figures").iterdir():
        assert picture.stat().st_size <= 150_000, picture.name
