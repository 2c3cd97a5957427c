"""Who asks, and what they may do.

A request has one principal: that of its token, or the one that everybody has without. The
middleware of `starcat.service.security` finds it out; handlers say which role they need.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated

from fastapi import Depends, Request

from starcat.service.problems import Problem


class Role(IntEnum):
    """What somebody may do; each role may do what those below may."""

    NONE = 0
    READER = 1
    BUILDER = 2
    PUBLISHER = 3

    @classmethod
    def named(cls, name: str) -> Role:
        """Return the role of a name such as ``reader``."""
        return cls[name.upper()]


@dataclass(frozen=True)
class Principal:
    """Who asks."""

    name: str  # name of the token; ``anonymous`` without one
    role: Role  # what they may do


def principal_of(request: Request) -> Principal:
    """Return who asks."""
    found = getattr(request.state, "principal", None)
    if isinstance(found, Principal):
        return found
    return Principal("anonymous", Role.named(request.app.state.service.settings.anonymous_role))


def needs(role: Role) -> Callable[[Request], Awaitable[Principal]]:
    """Return a dependency that refuses whoever has not a role."""

    async def check(request: Request) -> Principal:  # plain functions are sent to a thread
        principal = principal_of(request)
        if principal.role >= role:
            return principal
        name = role.name.lower()
        if principal.name == "anonymous":
            raise Problem(
                401,
                f"this needs a token with the role {name}; send it as 'Authorization: Bearer "
                "TOKEN', or sign in on the page",
                headers={"WWW-Authenticate": 'Bearer realm="starcat"'},
            )
        raise Problem(
            403,
            f"the token {principal.name!r} has the role {principal.role.name.lower()}, and this "
            f"needs {name}; ask the operator for another ('starcat token create')",
        )

    return check


Reader = Annotated[Principal, Depends(needs(Role.READER))]
Builder = Annotated[Principal, Depends(needs(Role.BUILDER))]
Publisher = Annotated[Principal, Depends(needs(Role.PUBLISHER))]
