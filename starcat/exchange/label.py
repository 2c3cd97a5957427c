"""What a file says of its table as a whole: its name, and the artifact that it is of."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Label:
    """The name and the origin of a table; what is not known is empty.

    Attributes
    ----------
    table : str
        Name of the product, or of the file that was exported.
    artifact, version : str
        The artifact that it is a product of.
    """

    table: str = ""
    artifact: str = ""
    version: str = ""

    @property
    def origin(self) -> dict[str, str]:
        """Artifact and version, where they are known."""
        known = {"artifact": self.artifact, "version": self.version}
        return {name: text for name, text in known.items() if text}


UNLABELLED = Label()
