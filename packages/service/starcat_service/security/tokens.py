"""Tokens and sessions: the roles of users, and until when; secrets are kept only as digests.

A token is 256 random bits, which cannot be guessed from their SHA-256 digest. A slow hash, which
passwords need, would delay each first request by a tenth of a second. The cookie of a session is
not the token: a leaked cookie is worthless after some hours, or when its token is revoked.
"""

from __future__ import annotations

import hashlib
import re
import secrets
import sqlite3
import time
from dataclasses import dataclass
from datetime import UTC, datetime

from starcat.errors import ConfigError, TargetMissing
from starcat_service.records import Records
from starcat_service.settings import Role

PREFIX = "starcat_"
"""Prefix of every token, for people and for scanners of leaked secrets."""

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._@-]{0,63}")
DAY_S = 86_400.0


@dataclass(frozen=True)
class Token:
    """The recorded facts of a token."""

    id: str  # eight hexadecimal digits
    name: str  # name of its user
    role: Role  # what its user may do
    # created_s, expires_s, revoked_s: seconds since 1970; the last two are None if it does not
    # expire, or was not revoked.
    created_s: float
    expires_s: float | None
    revoked_s: float | None

    def state(self, now_s: float) -> str:
        """Return whether it is ``valid``, ``expired`` or ``revoked`` at a time."""
        if self.revoked_s is not None:
            return "revoked"
        return "expired" if self.expires_s is not None and self.expires_s <= now_s else "valid"

    def as_dict(self) -> dict[str, str | None]:
        """Return its printed facts, with times in ISO 8601."""
        return {
            "id": self.id,
            "name": self.name,
            "role": self.role.name.lower(),
            "state": self.state(time.time()),
            "created": _date(self.created_s),
            "expires": _date(self.expires_s),
            "revoked": _date(self.revoked_s),
        }


class TokenStore:
    """The tokens of a service."""

    def __init__(self, records: Records) -> None:
        self._records = records

    def create(self, name: str, role: Role, expires_days: float | None = None) -> tuple[Token, str]:
        """Make a token."""
        check_name(name)
        text = PREFIX + secrets.token_urlsafe(32)
        now_s = time.time()
        expires_s = None if expires_days is None else now_s + expires_days * DAY_S
        with self._records.writing() as connection:
            same = connection.execute("SELECT * FROM tokens WHERE name = ?", (name,)).fetchall()
            if _valid(same) is not None:
                raise ConfigError(
                    f"there is a valid token with the name {name!r}",
                    key="name",
                    value=name,
                    hint="choose another name, or revoke that one first: starcat token revoke "
                    f"{name}",
                )
            token = Token(secrets.token_hex(4), name, role, now_s, expires_s, None)
            connection.execute(
                "INSERT INTO tokens (id, name, role, digest, created_s, expires_s) "
                "VALUES (?, ?, ?, ?, ?, ?)",
                (token.id, name, role.name.lower(), digest_of(text), now_s, expires_s),
            )
        return token, text

    def all(self) -> list[Token]:
        """Return all tokens, the oldest first, including tokens that are no longer valid."""
        rows = self._records.rows("SELECT * FROM tokens ORDER BY created_s, id")
        return [token_of(row) for row in rows]

    def has_valid(self) -> bool:
        """Return whether any valid token exists now."""
        return _valid(self._records.rows("SELECT * FROM tokens")) is not None

    def revoke(self, name: str) -> list[Token]:
        """Invalidate the valid tokens with a name or an id from now on."""
        now_s = time.time()
        revoked = [
            token
            for token in self.all()
            if name in (token.name, token.id) and token.state(now_s) == "valid"
        ]
        if not revoked:
            raise TargetMissing(
                f"no valid token has the name or id {name[:80]!r}",
                hint="'starcat token list' lists them",
            )
        with self._records.writing() as connection:
            for token in revoked:
                connection.execute(
                    "UPDATE tokens SET revoked_s = ? WHERE id = ?", (now_s, token.id)
                )
                connection.execute("DELETE FROM sessions WHERE token = ?", (token.id,))
        return revoked

    def find(self, text: str) -> Token | None:
        """Return the token of a text."""
        if not text.startswith(PREFIX):
            return None
        return _valid(self._records.rows("SELECT * FROM tokens WHERE digest = ?", digest_of(text)))


def check_name(name: str) -> None:
    """Check the name of a token."""
    if not NAME.fullmatch(name) or name == "anonymous":
        raise ConfigError(
            f"{name[:80]!r} cannot be the name of a token; expected 1 to 64 letters, digits and "
            "'.', '_', '@', '-', not 'anonymous'",
            key="name",
            value=name,
            hint="Choose another",
        )


def digest_of(secret: str) -> str:
    """Return the stored form of a secret: its SHA-256 digest in hexadecimal digits."""
    return hashlib.sha256(secret.encode()).hexdigest()


def token_of(row: sqlite3.Row) -> Token:
    """Return the token of a row of the records."""
    facts = {name: row[name] for name in Token.__dataclass_fields__}
    return Token(**{**facts, "role": Role.named(row["role"])})


def _valid(rows: list[sqlite3.Row]) -> Token | None:
    now_s = time.time()
    return next((token for token in map(token_of, rows) if token.state(now_s) == "valid"), None)


def _date(at_s: float | None) -> str | None:
    if at_s is None:
        return None
    return datetime.fromtimestamp(at_s, UTC).isoformat(timespec="seconds")


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
        """Return the token that a session was begun with; None if it is not valid."""
        rows = self._records.rows(
            "SELECT tokens.* FROM sessions JOIN tokens ON tokens.id = sessions.token "
            "WHERE sessions.digest = ? AND sessions.expires_s > ?",
            digest_of(secret),
            time.time(),
        )
        return _valid(rows)

    def close(self, secret: str) -> None:
        """End a session."""
        with self._records.writing() as connection:
            connection.execute("DELETE FROM sessions WHERE digest = ?", (digest_of(secret),))

    def count(self) -> int:
        """Return the number of sessions that have not expired."""
        unexpired = "SELECT count(*) FROM sessions WHERE expires_s > ?"
        [[count]] = self._records.rows(unexpired, time.time())
        return int(count)

    def forget_expired(self) -> int:
        """Remove the sessions that have expired, and return their number."""
        with self._records.writing() as connection:
            done = connection.execute("DELETE FROM sessions WHERE expires_s <= ?", (time.time(),))
        return done.rowcount
