"""An artifact as a program holds it: tables, matcher, queries, coverage."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starcat.api.connection import connect
from starcat.artifact.manifest import read_manifest
from starcat.resources import PathLike

if TYPE_CHECKING:  # a program that only matches has none of the libraries behind these
    import pyarrow as pa

    from starcat.artifact.verify import Verification
    from starcat.matcher.matcher import Matcher
    from starcat.query.answer import Answer
    from starcat.report.coverage_report import CoverageReport
    from starcat.specs.build_spec import BuildSpec


class Products(Mapping[str, "pa.Table"]):
    """The tables of an artifact by name; each is read when it is asked for.

    Parameters
    ----------
    folder : Path
        The artifact's folder.
    manifest : dict
        Its manifest.
    """

    def __init__(self, folder: Path, manifest: dict[str, Any]) -> None:
        self._folder = folder
        self._manifest = manifest

    def __getitem__(self, name: str) -> pa.Table:
        """Return a product as an Arrow table; `KeyError` if there is none of that name."""
        from starcat.artifact.reader import Artifact as Reader

        if name not in self._manifest["products"]:
            raise KeyError(name)
        return Reader(self._folder, self._manifest).table(name)

    def __iter__(self) -> Iterator[str]:
        """Go through the names, in the order of the manifest."""
        return iter(self._manifest["products"])

    def __len__(self) -> int:
        """Return the number of products."""
        return len(self._manifest["products"])

    def __repr__(self) -> str:
        """Return the names and rows in one line."""
        counts = [(name, one["rows"]) for name, one in self._manifest["products"].items()]
        return f"<Products: {', '.join(f'{name} ({rows:,})' for name, rows in counts)}>"


class Artifact:
    """A guide-star database on disk, opened by `open_artifact` (``starcat.open``).

    Parameters
    ----------
    folder : Path
        The folder ``<name>-<version>``.
    manifest : dict
        What it is made of: spec, sources, products, digests.
    """

    def __init__(self, folder: Path, manifest: dict[str, Any]) -> None:
        self.folder = folder
        self.manifest = manifest

    @property
    def products(self) -> Products:
        """The tables by name: ``artifact.products["pairs"]``."""
        return Products(self.folder, self.manifest)

    @cached_property
    def stars(self) -> pa.Table:
        """The guide stars as an Arrow table, by star number."""
        return self.products["stars"]

    @cached_property
    def spec(self) -> BuildSpec:
        """The spec that the artifact was built from."""
        from starcat.specs.reading import spec_from_dict

        return spec_from_dict(self.manifest["spec"], "manifest.json")

    def matcher(self, method: str | None = None, **limits: Any) -> Matcher:
        """Open the database for identifying stars.

        Parameters
        ----------
        method : str, optional
            As ``starcat methods`` lists them; the best that the products allow by default.
        **limits
            ``tolerance_px`` and the others of `Matcher.open`.

        Returns
        -------
        Matcher
            Ready to identify. Needs numpy and h5py only.
        """
        from starcat.matcher.matcher import Matcher

        return Matcher.open(self.folder, method, **limits)

    def sql(self, text: str, **values: Any) -> Answer:
        """Ask a query about the products.

        Parameters
        ----------
        text : str
            SQL, one statement that reads; every product is a table, the macros of
            ``docs/sql.md`` are there.
        **values
            Values of the ``$name`` in it.

        Returns
        -------
        Answer
            All rows.

        Raises
        ------
        QueryError
            If the text is no query that may run.
        """
        with connect(self.folder) as connection:
            return connection.sql(text, **values)

    def coverage(self) -> CoverageReport:
        """Return how many stars, pairs and triangles the fields hold.

        Returns
        -------
        CoverageReport
            As the report of the build has it.
        """
        from starcat.artifact.reader import Artifact as Reader
        from starcat.pipeline.facts import artifact_coverage

        return artifact_coverage(Reader(self.folder, self.manifest))

    def verify(self) -> Verification:
        """Check every file, order, index and reference.

        Returns
        -------
        Verification
            With its findings; none where all is well.
        """
        from starcat.artifact.verify import verify_artifact

        return verify_artifact(self.folder)

    def __repr__(self) -> str:
        """Return name, stars and field in one line."""
        stars = self.manifest["products"]["stars"]["rows"]
        name = f"{self.manifest['name']}-{self.manifest['version']}"
        epoch, count = self.manifest["epoch_jyear"], len(self.products)
        return f"<Artifact {name}: {stars:,} guide stars at J{epoch:g}, {count} products>"

    def _repr_html_(self) -> str:
        """Return the products as a table for a notebook."""
        from html import escape

        rows = "".join(
            f"<tr><td>{escape(name)}</td><td>{facts['rows']:,}</td></tr>"
            for name, facts in self.manifest["products"].items()
        )
        head = "<thead><tr><th>product</th><th>rows</th></tr></thead>"
        return f"<p>{escape(repr(self)[1:-1])}</p><table>{head}<tbody>{rows}</tbody></table>"


def open_artifact(folder: PathLike) -> Artifact:
    """Open a guide-star database.

    Parameters
    ----------
    folder : str or path-like
        The folder ``<name>-<version>`` that a build or a pull made.

    Returns
    -------
    Artifact
        With its manifest read; all else is read when it is asked for.

    Raises
    ------
    ProductError
        If the folder is not an artifact.
    SchemaVersionError
        If another version of starcat wrote it.
    """
    path = Path(folder)
    return Artifact(path, read_manifest(path))
