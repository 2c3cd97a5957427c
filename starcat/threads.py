"""A few threads that work on items while the next ones are read."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def map_in_order(
    function: Callable[[_Item], _Result], items: Iterator[_Item], workers: int = 2
) -> Iterator[_Result]:
    """Apply a function to items with a few threads, keeping their order.

    Few items are read ahead, so that memory stays flat. If reading an item fails, the results of
    the earlier items are returned first, and then the error is raised.
    """
    if not workers:
        yield from map(function, items)
        return
    pending: deque[Future[_Result]] = deque()
    failure = None
    pool, wait = ThreadPoolExecutor(workers), True
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
    except GeneratorExit:
        # The garbage collector closes a dropped generator in any thread, even in a thread of the
        # pool or one that is being started. Waiting there would never end.
        wait = False
        raise
    finally:
        pool.shutdown(wait=wait, cancel_futures=True)
    if failure is not None:
        raise failure
