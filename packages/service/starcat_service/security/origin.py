"""Defence against other sites: requests in a user's name, and requests under another host name.

A page of another site can make a browser send a form to this service, with the cookie if the
browser is old, and without any on a loopback address. It can also make its own name resolve to
127.0.0.1 (DNS rebinding). ``Sec-Fetch-Site`` and ``Origin`` show the first, ``Host`` the second.
"""

from __future__ import annotations

import ipaddress
import re
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.types import Scope

from starcat_service.access import session_in
from starcat_service.problems import Problem
from starcat_service.settings import ServiceSettings

SAFE = ("GET", "HEAD", "OPTIONS")
HOST = re.compile(r"(?P<name>\[[0-9A-Fa-f:.]{2,45}\]|[A-Za-z0-9._-]{1,253})(:(?P<port>\d{1,5}))?")


class Origins:
    """Refuses requests to other host names, and requests that other sites made a browser send."""

    def __init__(self, settings: ServiceSettings) -> None:
        self._settings = settings
        self._names = _known_names(settings)

    def check(self, scope: Scope) -> None:
        """Refuse a request for another host, or one that another site made the browser send."""
        headers = Headers(scope=scope)
        problem = self._misdirected(headers)
        if problem is None and scope["method"] not in SAFE:
            problem = self._forged(headers, scope["scheme"])
        if problem is not None:
            raise problem

    def _misdirected(self, headers: Headers) -> Problem | None:
        hosts = headers.getlist("host")
        host = HOST.fullmatch(hosts[0]) if len(hosts) == 1 else None
        if host is None:
            return Problem(400, "the header Host is missing, given twice, or no name of a host")
        if self._names is None or is_known(host["name"], self._names):
            return None
        return Problem(
            421,
            "this service has another name; use the address that 'starcat serve' prints, or set "
            "public_url to the address that people use",
        )

    def _forged(self, headers: Headers, scheme: str) -> Problem | None:
        site = headers.get("sec-fetch-site")
        if site is not None and site not in ("same-origin", "none"):
            return _other_site()
        origin = headers.get("origin")
        if origin is not None:
            origins = {f"{scheme}://{headers['host'].lower()}"}
            if self._settings.public_url is not None:
                origins.add(self._settings.public_url.lower().rstrip("/"))
            return None if origin.lower() in origins else _other_site()
        if site is None and session_in(headers.get("cookie", ""), self._settings) is not None:
            return Problem(
                403,
                "a request with the cookie of a browser needs the header Origin; programs send "
                "'Authorization: Bearer TOKEN' instead",
            )
        return None


def _known_names(settings: ServiceSettings) -> frozenset[str] | None:
    if not settings.is_loopback and settings.public_url is None:
        return None
    names = {"localhost", settings.host.lower()}
    if settings.public_url is not None:
        names.add((urlsplit(settings.public_url).hostname or "").lower())
    return frozenset(names)


def is_known(name: str, names: frozenset[str]) -> bool:
    """Return whether a service has this host name; an IP address cannot be rebound."""
    if name.lower() in names:
        return True
    try:
        ipaddress.ip_address(name.strip("[]"))
    except ValueError:
        return False
    return True


def _other_site() -> Problem:
    return Problem(
        403,
        "this was sent by a page of another site; use the page of the service itself, or a program "
        "with 'Authorization: Bearer TOKEN'",
    )
