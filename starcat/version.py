"""The version of starcat, and the name that pip installs it by."""

__version__ = "0.2.0"

DISTRIBUTION = "starcat-guide-stars"
"""On PyPI ``starcat`` is another project, a toolkit for star clusters."""


def install_command(extra: str) -> str:
    """Return what to type to have the libraries of an optional part.

    Examples
    --------
    >>> install_command("images")
    "pip install 'starcat-guide-stars[images]'"
    """
    return f"pip install '{DISTRIBUTION}[{extra}]'"
