"""The version of starcat, and the name that pip installs it by."""

__version__ = "0.2.0"

DISTRIBUTION = "starcat-guide-stars"
"""On PyPI ``starcat`` is another project, a toolkit for star clusters."""

MATCHER = "starcat-matcher"
"""The same import name with what identifies stars alone: numpy, h5py and cffi."""


def install_command(extra: str) -> str:
    """Return what to type to have the libraries of an optional part.

    Examples
    --------
    >>> install_command("images")
    "pip install 'starcat-guide-stars[images]'"
    """
    return f"pip install '{DISTRIBUTION}[{extra}]'"


def lacking(what: str, error: ModuleNotFoundError) -> str:
    """Return the sentence for what cannot run because a module is not there.

    Examples
    --------
    >>> print(lacking("build", ModuleNotFoundError(name="typer")))
    build needs the library 'typer', which is not installed; pip install starcat-guide-stars
    """
    name = (error.name or "").partition(".")[0]
    if name != "starcat":
        return (
            f"{what} needs the library {name!r}, which is not installed; pip install {DISTRIBUTION}"
        )
    return (
        f"{what} is not in {MATCHER}, which only identifies stars; pip uninstall {MATCHER}, then "
        f"pip install {DISTRIBUTION}"
    )
