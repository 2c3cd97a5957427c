"""Sign-ins on the page: a cookie with a random secret, which is kept as a digest, and expires.

The cookie does not carry the token: what leaks of a browser is worth nothing after some hours, or
after a sign-out, and cannot be used as a token elsewhere.
"""

from __future__ import annotations

import secrets
import time
from http.cookies import CookieError, SimpleCookie

from starcat.service.records import Records
from starcat.service.security.tokens import Token, digest_of, token_of
from starcat.service.settings import Settings


class SessionStore:
    """The sign-ins of a service."""

    def __init__(self, records: Records, hours: float) -> None:
        self._records = records
        self._lasts_s = hours * 3600.0

    def open(self, token: Token) -> str:
        """Begin a session."""
        secret = secrets.token_urlsafe(32)
        now_s = time.time()
        with self._records.writing() as connection:
            connection.execute(
                "INSERT INTO sessions VALUES (?, ?, ?, ?)",
                (digest_of(secret), token.id, now_s, now_s + self._lasts_s),
            )
        return secret

    def find(self, secret: str) -> Token | None:
        """Return the token that a session was begun with; None where none is valid."""
        now_s = time.time()
        with self._records.reading() as connection:
            row = connection.execute(
                "SELECT tokens.* FROM sessions JOIN tokens ON tokens.id = sessions.token "
                "WHERE sessions.digest = ? AND sessions.expires_s > ?",
                (digest_of(secret), now_s),
            ).fetchone()
        token = None if row is None else token_of(row)
        return token if token is not None and token.state(now_s) == "valid" else None

    def close(self, secret: str) -> None:
        """End a session."""
        with self._records.writing() as connection:
            connection.execute("DELETE FROM sessions WHERE digest = ?", (digest_of(secret),))

    def count(self) -> int:
        """Return the number of sessions that have not expired."""
        with self._records.reading() as connection:
            row = connection.execute(
                "SELECT count(*) FROM sessions WHERE expires_s > ?", (time.time(),)
            ).fetchone()
        return int(row[0])

    def forget_expired(self) -> int:
        """Remove the sessions that have expired, and return how many."""
        with self._records.writing() as connection:
            done = connection.execute("DELETE FROM sessions WHERE expires_s <= ?", (time.time(),))
        return done.rowcount


def cookie_name(settings: Settings) -> str:
    """Return the name of the cookie; behind https one that only this very host can set."""
    return "__Host-starcat" if settings.is_secure else "starcat"


def session_in(cookies: str, settings: Settings) -> str | None:
    """Return the secret of a session."""
    name = cookie_name(settings)
    if name not in cookies:
        return None
    try:
        found = SimpleCookie(cookies).get(name)
    except CookieError:
        return None
    return found.value or None if found is not None else None
