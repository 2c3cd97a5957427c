"""The version of starcat, the name that pip installs it by, and whether it is installed alone."""

from __future__ import annotations

import os  # not pathlib, which takes long to import
import sys

__version__ = "0.2.0"

DISTRIBUTION = "starcat-guide-stars"
"""On PyPI ``starcat`` is another project, a toolkit for star clusters."""

MATCHER = "starcat-matcher"
"""The distribution that only identifies stars; its import name is the same."""

OTHER_PROJECTS = {"starcatalog.py": "rms-starcat", "bonus.py": "starcat"}
"""Other projects on PyPI that install a package ``starcat``, each with a file unique to it."""

_FOLDER = os.path.dirname(os.path.abspath(__file__))


def install_command(extra: str = "") -> str:
    """Return the command that installs starcat, or the libraries of an optional part of it.

    It names the origin of this installation: a clone, or another file or address, else PyPI.

    Examples
    --------
    >>> install_command("images")  # in a clone
    "pip install -e '...[images]'"
    """
    import shlex
    from pathlib import Path

    extras = f"[{extra}]" if extra else ""
    clone = Path(_FOLDER).parent
    if (clone / "pyproject.toml").is_file() and (clone / "onboard").is_dir():
        return f"pip install -e {shlex.quote(f'{clone}{extras}')}"
    source = _installed_from()
    return f"pip install {shlex.quote(f'{DISTRIBUTION}{extras}' + (source and f' @ {source}'))}"


def _installed_from() -> str:
    """Return the address that pip installed starcat from (PEP 610), or an empty text for PyPI."""
    import json
    from importlib.metadata import PackageNotFoundError, distribution

    try:
        origin = json.loads(distribution(DISTRIBUTION).read_text("direct_url.json") or "{}")
    except PackageNotFoundError:
        return ""
    if "vcs_info" in origin:
        return f"{origin['vcs_info']['vcs']}+{origin['url']}@{origin['vcs_info']['commit_id']}"
    return str(origin.get("url", ""))


def missing_packages(what: str, error: ModuleNotFoundError) -> str:
    """Return the message for a command or part that cannot run because a module is missing.

    Examples
    --------
    >>> print(missing_packages("build", ModuleNotFoundError(name="typer")))
    build needs the library 'typer', which is not installed; pip install ...
    """
    name = (error.name or "").partition(".")[0]
    if name != "starcat":
        return f"{what} needs the library {name!r}, which is not installed; {install_command()}"
    return (
        f"{what} is not in {MATCHER}, which only identifies stars; pip uninstall {MATCHER}, then "
        f"{install_command()}"
    )


def mixed_with() -> str:
    """Return a message if the folder of this package has files of another project, else ''.

    It looks for two files, which takes some microseconds. Every import of starcat calls it.
    """
    others = [
        project
        for name, project in OTHER_PROJECTS.items()
        if os.path.exists(os.path.join(_FOLDER, name))
    ]
    if not others:
        return ""
    names = " and ".join(others)
    return (
        f"{_FOLDER} has files of the project {names} and of {DISTRIBUTION}. Both are imported as "
        f"'starcat', so that they cannot be in one environment. Uninstall both (pip uninstall "
        f"{' '.join(others)} {DISTRIBUTION} {MATCHER}), then install one of them again"
    )


def damaged_by_others() -> str:
    """Return a message if another project has changed this package, else ''.

    The command line calls it. Unlike `mixed_with` it also notices if ``starcat/__init__.py``
    belongs to another project, or was removed with it.
    """
    text = mixed_with()
    if text or "Matcher" in getattr(sys.modules["starcat"], "__all__", ()):
        return text
    return (
        f"{_FOLDER}/__init__.py is missing or of another project: pip replaced or removed it with "
        f"another project that is imported as 'starcat'. Install {DISTRIBUTION} again: pip "
        f"uninstall {DISTRIBUTION} {MATCHER}, then {install_command()}"
    )
