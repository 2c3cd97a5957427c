"""The page to sign in at; what it sends is taken by `starcat.service.security`."""

from __future__ import annotations

from typing import Annotated

from fastapi import Query, Request
from fastapi.responses import Response

from starcat.service.pages.rendering import page_router, render

router = page_router()


@router.get("/sign-in")
def sign_in_page(
    request: Request, next_address: Annotated[str, Query(alias="next")] = "/"
) -> Response:
    """Show who is signed in, and the form for a token."""
    return sign_in_form(request, next_address)


def sign_in_form(
    request: Request, next_address: str, error: str | None = None, status: int = 200
) -> Response:
    """Return the page to sign in at."""
    address = own_path(next_address)
    return render(request, "sign_in.html", status=status, next=address, error=error)


def own_path(address: str) -> str:
    """Return a path of this service that a browser may be led to.

    Examples
    --------
    >>> [own_path(one) for one in ("/jobs?state=done", "//elsewhere.example", "https://x.example")]
    ['/jobs?state=done', '/', '/']
    """
    is_own = address.startswith("/") and not address.startswith("//") and "\\" not in address
    return address if is_own and address.isprintable() else "/"
