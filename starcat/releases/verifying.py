"""Verify a registry: read every release, and check it like a pull."""

from __future__ import annotations

import tempfile
from pathlib import Path

from starcat.artifact.verify import Finding, Verification
from starcat.errors import ProductError, SchemaError, SourceError
from starcat.progress import Progress, no_progress
from starcat.releases.pulling import pull_release
from starcat.releases.registry import open_registry
from starcat.releases.signing import signatures_of
from starcat.releases.tree import INDEX_NAME


def verify_registry(
    text: str, trust: Path | None = None, progress: Progress = no_progress
) -> Verification:
    """Check files, databases and signatures of all releases, in a folder or at an address.

    ``trust`` is a public key, or a root, that must have signed them; it is stored as by a pull.
    The product of a finding is the release that it concerns.
    """
    registry, findings = open_registry(text), []
    listed = registry.releases()
    states = signatures_of(text, listed)
    for release, state in zip(listed, states, strict=True):
        if state not in ("yes", "no"):
            findings.append(Finding(INDEX_NAME, release.title, state))
        try:
            if trust is not None:
                from starcat.releases.trust import signed_release

                signed_release(registry, release.name, release.version, trust)
            with tempfile.TemporaryDirectory(prefix="starcat-") as folder:
                pull_release(registry, release, Path(folder), progress)
        except (ProductError, SchemaError, SourceError) as error:
            findings.append(Finding(release.path, release.title, str(error)))
    files = sum(release.files for release in listed)
    return Verification(Path(text), files + len(listed), tuple(findings))
