"""The documentation site: Markdown pages of this folder, built by ``make docs``."""

from starcat.version import __version__

project = "starcat"
author = "the starcat developers"
project_copyright = author
version = release = __version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
]
myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 3

napoleon_numpy_docstring = True
napoleon_google_docstring = False
napoleon_use_rtype = False
autodoc_typehints = "none"
autodoc_member_order = "bysource"

# The lexer of SQL knows no $name.
suppress_warnings = ["misc.highlighting_failure"]

html_theme = "furo"
html_title = f"starcat {__version__}"
html_show_copyright = False
html_copy_source = False
exclude_patterns = ["figures"]
