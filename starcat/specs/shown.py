"""Values of a TOML file in messages, as TOML writes them."""

from __future__ import annotations

import datetime
import reprlib
from itertools import islice
from typing import Any


class _Shown(reprlib.Repr):
    """Shows a value of any length or depth in a message, as TOML writes it."""

    def repr_bool(self, x: bool, level: int) -> str:
        """Return true or false."""
        return str(x).lower()

    def repr_dict(self, x: dict[str, Any], level: int) -> str:
        """Return an inline table."""
        if level <= 0 and x:
            return "{...}"
        some = islice(x.items(), self.maxdict)
        shown = [f"{key} = {self.repr1(value, level - 1)}" for key, value in some]
        more = ["..."] if len(x) > self.maxdict else []
        return f"{{{', '.join([*shown, *more])}}}"

    def repr_date(self, x: datetime.date | datetime.time, level: int) -> str:
        """Return a date, a time or both."""
        return x.isoformat()

    repr_datetime = repr_time = repr_date

    def repr_int(self, x: int, level: int) -> str:
        """Return a number; Python refuses to write one of more than 4,300 digits."""
        if x.bit_length() > 1000:
            return f"a number of {x.bit_length():,} bits"
        return super().repr_int(x, level)


_SHOWN = _Shown()
_SHOWN.maxstring = _SHOWN.maxlong = _SHOWN.maxother = 100


def toml_shown(value: Any) -> str:
    """Return a value as TOML writes it, cut if it is long or deep.

    Examples
    --------
    >>> toml_shown({"a": [True, 1.5], "b": "text"})
    "{a = [true, 1.5], b = 'text'}"
    """
    return _SHOWN.repr(value)
