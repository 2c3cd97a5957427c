"""Open parts of an HDF5 file from an untrusted source.

In HDF5 a part of a file can be elsewhere: links lead to other files, datasets are stored in
separate raw files or combined from other datasets, and a declared shape can have no data. These
functions open only parts that are stored contiguously in the file itself.
"""

from __future__ import annotations

from typing import Any

from starcat.errors import ProductError

NUMBERS_AND_TEXTS = "iufS"
"""Allowed kinds of dtype of a dataset: integers, floats and texts of a fixed width."""


def own_group(file: Any, name: str) -> Any:
    """Return a group of a file."""
    group = _hard_linked(file, name)
    if not hasattr(group, "keys"):
        raise _refused(group.name, "no group")
    return group


def own_dataset(group: Any, name: str, file_bytes: int) -> Any:
    """Return a dataset whose values are stored contiguously in the file."""
    dataset = _hard_linked(group, name)
    path = f"{group.name}/{name}"
    if not hasattr(dataset, "shape"):
        raise _refused(path, "no dataset")
    if dataset.is_virtual or dataset.external is not None:
        raise _refused(path, "stored in other files")
    if dataset.chunks is not None:
        raise _refused(path, "stored in chunks")
    try:
        dtype = dataset.dtype
    except (TypeError, ValueError, KeyError) as error:
        raise _refused(path, f"of a type that numpy lacks ({error})") from error
    if dtype.kind not in NUMBERS_AND_TEXTS or not dtype.isnative:
        raise _refused(path, f"of type {dtype}")
    if dataset.shape is None or len(dataset.shape) != 1:
        raise _refused(path, f"of shape {dataset.shape}")
    size = dataset.shape[0] * dtype.itemsize
    offset = dataset.id.get_offset()
    if size and (offset is None or offset + size > file_bytes):
        raise _refused(path, f"declared with {size} bytes, which are not in the file")
    return dataset


def _hard_linked(group: Any, name: str) -> Any:
    """Return the target of a hard link of a group; refuse other links, which can lead anywhere."""
    link = type(group.get(name, getlink=True)).__name__
    if link != "HardLink":
        raise _refused(f"{group.name.rstrip('/')}/{name}", f"a link to somewhere else ({link})")
    return group[name]


def _refused(path: str, what: str) -> ProductError:
    return ProductError(
        f"{path} is {what}; expected what 'starcat build' writes, one piece in the file itself",
        hint="Build the database again, or get it from a trusted source",
    )
