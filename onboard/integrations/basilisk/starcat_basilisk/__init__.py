# SPDX-License-Identifier: MIT
"""A star tracker for Basilisk that identifies the stars of its frames with starcat's C library."""

from __future__ import annotations

import sys

from ._bsk_compatibility import check_basilisk_compatibility

check_basilisk_compatibility()

from Basilisk.architecture import cSysModel  # noqa: E402 - after the check

# Modules made by SWIG import their base class by this name.
sys.modules.setdefault("cSysModel", cSysModel)

from . import messaging, starcatFilter, starcatTracker  # noqa: E402 - the base class comes first

__all__ = ["messaging", "starcatFilter", "starcatTracker"]
