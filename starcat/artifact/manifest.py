"""The manifest: what an artifact is made of, with a digest for every part.

Nothing in it depends on the clock, the host or a path, so the same inputs and the same spec
give the same manifest.
"""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starcat import __version__
from starcat.errors import ArtifactMissing, ProductError, SchemaVersionError

if TYPE_CHECKING:  # reading a manifest needs none of these
    from starcat.catalog.ingest import FileFacts
    from starcat.tables.schema import ProductSchema

MANIFEST_NAME = "manifest.json"
MANIFEST_VERSION = "1.0.0"
COUNTERPARTS_VERSION = "1.1.0"
"""Of a manifest that lists catalogs of counterparts: the others stay as they were before."""

DATABASE_NAME = "database.h5"
PARTS = ("name", "version", "frame", "epoch_jyear", "spec", "sources", "products", "files")
LIBRARIES = ("numpy", "scipy", "pyerfa", "pyarrow", "h5py", "pydantic", "matplotlib", "pillow")


@dataclass(frozen=True)
class SourceFacts:
    """One source of a build as the manifest records it.

    Attributes
    ----------
    source, role : str
        Name of the data source; ``stars``, ``variability`` or ``crossmatch``.
    files : sequence of FileFacts
        Its input files.
    rows_read, kept : int
        Records, and how many of them became guide stars (of a joined source: were usable).
    rejected : dict of str to int
        The others, by reason.
    joined : int, optional
        Stars whose amplitude came from this source, or whose counterpart is in it.
    """

    source: str
    role: str
    files: Sequence[FileFacts]
    rows_read: int
    kept: int
    rejected: dict[str, int]
    joined: int | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return the facts as the manifest holds them.

        Returns
        -------
        dict
            Plain values.
        """
        facts: dict[str, Any] = {
            "source": self.source,
            "role": self.role,
            "files": [vars(file) for file in self.files],
            "rows_read": self.rows_read,
            "kept": self.kept,
            "rejected": self.rejected,
        }
        if self.joined is not None:
            facts["joined"] = self.joined
        return facts


@dataclass(frozen=True)
class ProductFacts:
    """One product of an artifact as the manifest records it.

    Attributes
    ----------
    schema : ProductSchema
        Its contract.
    rows : int
        Rows of its table.
    content_sha256 : str
        Digest of its values.
    in_database : bool
        Whether the HDF5 file has it too.
    records : int, optional
        Of triangles: the sum over all boresights, which the papers count.
    """

    schema: ProductSchema
    rows: int
    content_sha256: str
    in_database: bool
    records: int | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return the facts as the manifest holds them.

        Returns
        -------
        dict
            Plain values.
        """
        facts: dict[str, Any] = {
            "schema": self.schema.name,
            "rows": self.rows,
            "content_sha256": self.content_sha256,
            "parquet": f"{self.schema.product}.parquet",
            "in_database": self.in_database,
        }
        if self.records is not None:
            facts["records"] = self.records
        return facts


def manifest_version(sources: Sequence[SourceFacts]) -> str:
    """Return the version of the manifest of a build.

    Parameters
    ----------
    sources : sequence of SourceFacts
        What went in.

    Returns
    -------
    str
        The lowest that knows all of their roles.
    """
    roles = {source.role for source in sources}
    return COUNTERPARTS_VERSION if "crossmatch" in roles else MANIFEST_VERSION


def software_versions() -> dict[str, str]:
    """Return the versions of what computes and writes the products.

    Returns
    -------
    dict of str to str
        starcat, Python and the libraries whose version can change a byte.
    """
    found = {name: version(name) for name in LIBRARIES}
    return {"starcat": __version__, "python": platform.python_version(), **found}


def manifest_digest(manifest: Mapping[str, Any]) -> str:
    """Return the digest that a manifest carries of itself.

    Parameters
    ----------
    manifest : mapping
        With or without its ``manifest_sha256``.

    Returns
    -------
    str
        SHA-256, hexadecimal, of the canonical JSON of all other keys.
    """
    from starcat.storage.digests import json_bytes  # with pyarrow, which reading does without

    others = {key: value for key, value in manifest.items() if key != "manifest_sha256"}
    return hashlib.sha256(json_bytes(others)).hexdigest()


def _lacks(error: Exception) -> str:
    return f"no {error.args[0]}" if isinstance(error, KeyError) else str(error)


def read_manifest(folder: Path) -> dict[str, Any]:
    """Read the manifest of an artifact.

    Parameters
    ----------
    folder : Path
        The artifact.

    Returns
    -------
    dict
        Plain values; ``schemas/manifest-*.json`` says which.

    Raises
    ------
    ArtifactMissing
        If there is no folder, or no manifest in it.
    ProductError
        If the manifest cannot be read.
    SchemaVersionError
        If the manifest is of a version that this starcat does not know.
    """
    path = folder / MANIFEST_NAME
    try:
        manifest = json.loads(path.read_bytes())
        found = str(manifest["manifest_version"])
    except OSError as error:
        is_missing = isinstance(error, FileNotFoundError | NotADirectoryError)
        raise (ArtifactMissing if is_missing else ProductError)(
            f"{folder}: not an artifact, {MANIFEST_NAME} cannot be read ({error.strerror}); give "
            "the folder <name>-<version> that 'starcat build' made",
            path=folder,
        ) from error
    except (ValueError, KeyError, TypeError) as error:
        raise ProductError(
            f"{path}: not a starcat manifest ({_lacks(error)}); rebuild the artifact",
            path=path,
        ) from error
    if found.split(".")[0] != MANIFEST_VERSION.split(".")[0]:
        software = manifest.get("software")
        made_by = software.get("starcat") if isinstance(software, dict) else None
        raise SchemaVersionError(
            f"{path}: manifest version {found}; this starcat reads {MANIFEST_VERSION}. Install "
            f"starcat {made_by or 'of the release that wrote it'}",
            product="manifest",
            found=found,
            expected=MANIFEST_VERSION,
        )
    lacking = [part for part in PARTS if part not in manifest]
    if lacking:
        raise ProductError(
            f"{path}: not a starcat manifest (no {', '.join(lacking)}); rebuild the artifact",
            path=path,
        )
    return dict(manifest)
