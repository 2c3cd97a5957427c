"""The token behind a secret, remembered for some seconds so that most requests look up nothing."""

from __future__ import annotations

import time
from collections import OrderedDict

from starcat.service.security.buckets import Buckets
from starcat.service.security.login_sessions import SessionStore
from starcat.service.security.tokens import Token, TokenStore, digest_of
from starcat.service.service import Service

KNOWN_S = 5.0
"""Seconds that a secret is believed without looking it up; a revoked token ends within them."""

MOST_KNOWN = 1_000

GUESSES_PER_MINUTE = 10
"""Wrong tokens of an address. Right ones are let through all the same: who guesses 256 bits does
not succeed, and a colleague behind the same address is not to be locked out by a stale script."""


class Identities:
    """Who there is: tokens and sign-ins."""

    def __init__(self, service: Service) -> None:
        self.tokens = TokenStore(service.records)
        self.sessions = SessionStore(service.records, service.settings.session_hours)
        self.guessed = Buckets(GUESSES_PER_MINUTE)
        self._known: OrderedDict[str, tuple[Token, float]] = OrderedDict()

    def of_token(self, text: str) -> Token | None:
        """Return the token of a text; None where there is no valid one."""
        return self._lookup(self.tokens, text)

    def of_session(self, secret: str) -> Token | None:
        """Return the token that a session was begun with; None where there is no valid one."""
        return self._lookup(self.sessions, secret)

    def sign_out(self, secret: str) -> None:
        """End a session at once."""
        self._known.pop(f"{SessionStore.__name__} {digest_of(secret)}", None)
        self.sessions.close(secret)

    def _lookup(self, store: TokenStore | SessionStore, secret: str) -> Token | None:
        key, now_s = f"{type(store).__name__} {digest_of(secret)}", time.monotonic()
        known = self._known.get(key)
        if known is not None and known[1] > now_s:
            return known[0]
        # One look-up by an index in a file that is in memory: less than handing it to a thread.
        token = store.find(secret)
        if token is None:
            self._known.pop(key, None)
            return None
        self._known[key] = token, now_s + KNOWN_S
        if len(self._known) > MOST_KNOWN:
            self._known.popitem(last=False)
        return token
