"""The documentation site: Markdown pages of this folder, built by ``make docs``."""

import re
from pathlib import Path

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml

from starcat.version import __version__

project = "starcat"
author = "the starcat developers"
project_copyright = author
version = release = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.napoleon"]
html_math_renderer = "mathml"
myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 3

napoleon_numpy_docstring = True
napoleon_google_docstring = False
napoleon_use_rtype = False
autodoc_typehints = "none"
autosummary_generate = False
autodoc_member_order = "bysource"

# The lexer of SQL does not accept $name.
suppress_warnings = ["misc.highlighting_failure"]

html_theme = "furo"
html_title = f"starcat {__version__}"
html_show_copyright = False
html_copy_source = False
_citation = (Path(__file__).parents[1] / "CITATION.cff").read_text(encoding="utf-8")
# The link to the repository is drawn when its address is public.
if _found := re.search(r"^repository-code: \"?(https://[^\s\"]+)", _citation, re.MULTILINE):
    html_theme_options = {
        "source_repository": _found[1],
        "source_branch": "main",
        "source_directory": "docs/",
    }
exclude_patterns = ["figures"]


def write_inline(page, node):
    """Write a formula of the text as MathML, which browsers draw without a script."""
    page.body.append(tex2mathml(node.astext()))
    raise nodes.SkipNode


def write_block(page, node):
    """Write a formula that stands by itself."""
    formula = tex2mathml(node.astext().strip(), as_block=True)
    page.body.append(f'<div class="math">{formula}</div>\n')
    raise nodes.SkipNode


def write_reference(app):
    """Write the pages of reference, whose source is the program itself."""
    from starcat.cli import REFERENCE

    for name, page in REFERENCE.items():
        path, text = app.srcdir / f"{name}.md", page().rstrip() + "\n"
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def setup(app):
    """Write formulas without MathJax, which would be loaded from another server."""
    app.connect("builder-inited", write_reference)
    app.add_html_math_renderer("mathml", (write_inline, None), (write_block, None))
