"""Plain language: no pattern of sentences that make a reader stop becomes more frequent."""

from __future__ import annotations

import tomllib
from pathlib import Path

from plain import find_hits

LIMITS = Path(__file__).parents[1] / "data" / "plain.toml"


def test_no_pattern_becomes_more_frequent(monkeypatch):
    monkeypatch.chdir(Path(__file__).parents[2])
    _, hits = find_hits()
    limits = tomllib.loads(LIMITS.read_text(encoding="utf-8"))
    counts = {label.split()[0]: len(found) for label, found in hits.items()}
    more = {label: count for label, count in counts.items() if count > limits[label]}
    assert not more, "see: python tools/plain.py --show PATTERN"
