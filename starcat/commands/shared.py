"""What the commands share: common options, and how texts become inputs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from starcat.errors import ConfigError

if TYPE_CHECKING:
    from starcat.specs.build_spec import BuildSpec

Json = Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")]
Input = Annotated[
    list[str] | None,
    typer.Option("--input", metavar="SOURCE=PATH", help="File or folder of a source. Repeatable."),
]
MethodName = Annotated[
    str | None, typer.Option(help="See 'starcat methods'; default: the best there is.")
]
NoisePx = Annotated[float, typer.Option(min=0, max=50, help="Of a centroid, each axis.")]


def chosen_spec(path: Path | None, name: str | None) -> BuildSpec:
    """Return the spec of a file or of a preset.

    Parameters
    ----------
    path : Path, optional
        A TOML file.
    name : str, optional
        A preset.

    Returns
    -------
    BuildSpec
        Checked.

    Raises
    ------
    ConfigError
        If both are given or neither is, or the spec is wrong.
    """
    from starcat.specs.build_spec import preset as named_preset
    from starcat.specs.build_spec import preset_names, read_spec

    if path is not None and name is not None:
        raise ConfigError("give either a spec file or --preset, not both")
    if path is not None:
        return read_spec(path)
    if name is None:
        raise ConfigError(
            "say what to build: a spec (TOML), or --preset with one of " + ", ".join(preset_names())
        )
    return named_preset(name)


def inputs_by_source(given: list[str] | None, only: str | None = None) -> Mapping[str, list[Path]]:
    """Return the paths of ``SOURCE=PATH`` texts by source.

    Parameters
    ----------
    given : list of str, optional
        Texts of ``--input``.
    only : str, optional
        The source that a text without one is about, where a command is about one source.

    Returns
    -------
    mapping of str to list of Path
        Empty for none.

    Raises
    ------
    ConfigError
        If a text is of another form, or the source is unknown.
    """
    from starcat.catalog.source import data_source

    inputs: dict[str, list[Path]] = {}
    for text in given or []:
        name, separator, path = text.partition("=")
        if only is not None and (name != only or not separator):
            name, separator, path = only, "=", text
        if not separator or not path:
            raise ConfigError(f"--input {text!r} is not SOURCE=PATH, such as sao=sao.dat.gz")
        inputs.setdefault(data_source(name).name, []).append(Path(path))
    return inputs
