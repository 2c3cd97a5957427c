"""Taking turns: so many at the same time, and the others wait without holding a thread."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import ParamSpec, TypeVar

import anyio
from anyio import CapacityLimiter, to_thread

from starcat.service.problems import Problem

WAIT_S = 10.0
"""Seconds that a question waits for others to be answered."""

P = ParamSpec("P")
T = TypeVar("T")


class Turns:
    """Threads for what takes long; handlers that only read have all others for themselves."""

    def __init__(self, count: int) -> None:
        self._turns = CapacityLimiter(count)

    async def run(self, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Call a function in a thread when it is its turn."""
        turn = object()
        with anyio.move_on_after(WAIT_S) as waiting:
            await self._turns.acquire_on_behalf_of(turn)
        if waiting.cancelled_caught:
            raise busy()
        try:
            # It is its turn already: this limiter keeps nobody waiting.
            return await to_thread.run_sync(
                partial(function, *args, **kwargs), limiter=CapacityLimiter(1)
            )
        finally:
            self._turns.release_on_behalf_of(turn)


def busy() -> Problem:
    """Return what is said to somebody who waited too long."""
    return Problem(
        503,
        f"all that may run at the same time was busy for {WAIT_S:g} s; ask again later",
        headers={"Retry-After": f"{WAIT_S:.0f}"},
    )
