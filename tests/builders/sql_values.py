"""Values of SQL and of Python, for the tests of every engine that answers queries."""

from __future__ import annotations

import datetime as dt
from decimal import Decimal
from uuid import UUID

import numpy as np

DAY, UTC = dt.date(2020, 2, 29), dt.UTC
ZONE = dt.timezone(dt.timedelta(hours=-3, minutes=-30))
NUMBER = UUID("3f2504e0-4f89-11d3-9a0c-0305e82c3301")

VALUES: dict[str, object] = {
    "true": True,
    "-5::TINYINT": -5,
    "9223372036854775807": 2**63 - 1,
    "18446744073709551615::UBIGINT": 2**64 - 1,
    "170141183460469231731687303715884105727::HUGEINT": 2**127 - 1,
    "340282366920938463463374607431768211455::UHUGEINT": 2**128 - 1,
    "'123456789012345678901234567890123456789012345'::BIGNUM": "123456789012345678901234567890"
    "123456789012345",
    "1.5::FLOAT": 1.5,
    "-0.0::DOUBLE": -0.0,
    "'nan'::DOUBLE": float("nan"),
    "'-inf'::DOUBLE": float("-inf"),
    "1.10::DECIMAL(9,2)": Decimal("1.10"),
    "12345678901234567890123456789012345678::DECIMAL(38,0)": Decimal(
        "12345678901234567890123456789012345678"
    ),
    "'é\N{GLOWING STAR}'": "é\N{GLOWING STAR}",
    "'two' || chr(10) || 'lines' || chr(0)": "two\nlines\0",
    "'\\x00\\xFF'::BLOB": b"\0\xff",
    "'101'::BIT": "101",
    "NULL": None,
    "DATE '2020-02-29'": DAY,
    "'infinity'::DATE": dt.date.max,
    "'290000-01-01'::DATE": "290000-01-01",
    "TIME '12:34:56.789'": dt.time(12, 34, 56, 789000),
    "TIME '24:00:00'": "24:00:00",
    "TIMETZ '12:00:00.5-03:30'": dt.time(12, 0, 0, 500000, tzinfo=ZONE),
    "TIMESTAMP '2020-01-01 01:02:03.000004'": dt.datetime(2020, 1, 1, 1, 2, 3, 4),
    "'-infinity'::TIMESTAMP": dt.datetime.min,
    "'2020-01-01 00:00:01.123456789'::TIMESTAMP_NS": dt.datetime(2020, 1, 1, 0, 0, 1, 123456),
    "TIMESTAMPTZ '2020-01-01 00:00:00+05'": dt.datetime(2019, 12, 31, 19, tzinfo=UTC),
    "'infinity'::TIMESTAMPTZ": dt.datetime.max.replace(tzinfo=UTC),
    "INTERVAL '1 year 2 days 3 microseconds'": "1 year 2 days 00:00:00.000003",
    "INTERVAL '-1 day'": "-1 day",
    f"'{NUMBER}'::UUID": NUMBER,
    "'x'::ENUM('x', 'y')": "x",
    "[[1], NULL, []]": [[1], None, []],
    "[array_value(1.5::DOUBLE, 2)]": [(1.5, 2.0)],
    "{'a': 1, 'b': [DATE '2020-02-29', NULL]}": {"a": 1, "b": [DAY, None]},
    "MAP{DATE '2020-02-29': 2.5}": {DAY: Decimal("2.5")},
    "MAP{[1, 2]: 'x'}": {"key": [[1, 2]], "value": ["x"]},
    "MAP([]::INT[], []::INT[])": {},
    "union_value(k := 'x'::BLOB)": b"x",
    "(1, 'x')": (1, "x"),
    "['tuple', 'x']": ["tuple", "x"],
}
"""Each type of DuckDB, and its value in Python."""

GIVEN = [
    (value, value)
    for value in (
        None, True, 7, -(2**127), 1.5, "half \N{GLOWING STAR}", b"\0\xff", Decimal("1.50"), DAY,
        dt.datetime(2020, 1, 1, 2, 3, 4, 5), dt.time(1, 2, 3), dt.time(12, tzinfo=UTC),
        dt.datetime(2020, 1, 1, tzinfo=UTC), NUMBER, [1, None], {"a": [DAY]},
        [], {},
    )
] + [
    (bytearray(b"y"), b"y"),
    (dt.timedelta(1, 2, 3), "1 day 00:00:02.000003"),
    ((1, 2), [1, 2]),
    ({"key": [1], "value": [2]}, {1: 2}),
    (np.float64(2.5), 2.5),
    (np.int64(3), 3),
    (np.array([1.5]), [1.5]),
    (np.datetime64("2020-02-29"), DAY),
]  # fmt: skip
"""Values of a query's parameters, and the values that the query returns."""
