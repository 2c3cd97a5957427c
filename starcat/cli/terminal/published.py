"""What publish, pull and releases print: tables for people or JSON for machines."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from starcat.cli.terminal.console import print_json, print_table, say

if TYPE_CHECKING:
    from starcat.releases.publishing import Published
    from starcat.releases.pulling import Pulled
    from starcat.releases.tree import Listed

DIGEST_LETTERS = 16
"""Letters of a digest that a table shows; JSON has all."""


def print_published(published: Published, *, as_json: bool) -> None:
    """Print what became of a publication."""
    release = published.release
    if as_json:
        print_json(published.as_dict())
        return
    row = (
        release.name,
        release.version,
        release.files,
        f"{release.bytes:,}",
        published.new_blobs,
        f"{published.new_bytes:,}",
        release.manifest.sha256[:DIGEST_LETTERS],
    )
    columns = ("artifact", "version", "files", "bytes", "new files", "new bytes", "manifest")
    print_table("", columns, [row], numbers=(2, 3, 4, 5))
    say(f"{published.outcome}: {release.title} in {published.registry}")


def print_pulled(pulled: Sequence[Pulled], *, as_json: bool) -> None:
    """Print what became of pulls."""
    if as_json:
        print_json([one.as_dict() for one in pulled])
        return
    rows = [
        (
            one.release.name,
            one.release.version,
            one.release.manifest.sha256[:DIGEST_LETTERS],
            str(one.folder),
        )
        for one in pulled
    ]
    print_table("", ("artifact", "version", "manifest", "folder"), rows)
    for one in pulled:
        say(f"{one.outcome}: {one.folder}")


def print_releases(releases: Sequence[Listed], *, as_json: bool) -> None:
    """Print what a registry lists."""
    highest = {release.name: release for release in releases}
    if as_json:
        marked = [r.model_dump() | {"is_latest": highest[r.name] is r} for r in releases]
        print_json(marked)
        return
    rows = [
        (
            release.name,
            release.version,
            "latest" if highest[release.name] is release else "",
            release.files,
            f"{release.bytes:,}",
            release.manifest.sha256[:DIGEST_LETTERS],
        )
        for release in releases
    ]
    columns = ("artifact", "version", "", "files", "bytes", "manifest")
    print_table("", columns, rows, numbers=(3, 4))
