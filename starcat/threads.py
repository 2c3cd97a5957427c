"""A few threads that work on items while the next ones are read."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from threading import current_thread
from typing import TypeVar

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

_THREAD_NAME = "map-in-order"


def map_in_order(
    function: Callable[[_Item], _Result], items: Iterator[_Item], workers: int = 2
) -> Iterator[_Result]:
    """Apply a function to items with a few threads, keeping their order.

    Few items are read ahead, so that memory stays flat. An error of the items is raised after
    the results of those before it.
    """
    if not workers:
        yield from map(function, items)
        return
    pending: deque[Future[_Result]] = deque()
    failure = None
    pool = ThreadPoolExecutor(workers, _THREAD_NAME)
    try:
        while True:
            try:
                item = next(items)
            except StopIteration:
                break
            except Exception as error:
                failure = error
                break
            pending.append(pool.submit(function, item))
            if len(pending) > workers + 1:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
    finally:  # a generator that was dropped may be closed in a thread of the pool itself
        is_own = current_thread().name.startswith(_THREAD_NAME)
        pool.shutdown(wait=not is_own, cancel_futures=True)
    if failure is not None:
        raise failure
