"""Style sheet, scripts and pictures of the page; their digest is in their address."""

from __future__ import annotations

import hashlib
from pathlib import Path

from fastapi import APIRouter
from fastapi.responses import Response

from starcat.service.problems import Problem

MEDIA_TYPES = {
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}

FILES = {
    path.name: path.read_bytes()
    for path in sorted((Path(__file__).parent / "static").iterdir())
    if path.suffix in MEDIA_TYPES
}
"""All of them by name, read once: no path is ever made of a request."""

DIGEST = hashlib.sha256(b"".join(FILES[name] for name in sorted(FILES))).hexdigest()[:12]
"""One digest for all, so that a script may import another by its name."""

router = APIRouter(include_in_schema=False)


def static_address(name: str) -> str:
    """Return the address of a static file."""
    if name not in FILES:
        raise KeyError(name)
    return f"/static/{DIGEST}/{name}"


@router.get("/static/{digest}/{name}")
def static_file(digest: str, name: str) -> Response:
    """Give a static file; those of an older version are gone."""
    if digest != DIGEST or name not in FILES:
        raise Problem(404, "there is no such file of the page; load the page again")
    return Response(
        FILES[name],
        media_type=MEDIA_TYPES[Path(name).suffix],
        headers={"Cache-Control": "public, max-age=31536000, immutable", "ETag": f'"{DIGEST}"'},
    )
