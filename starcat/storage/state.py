"""The folder of a user in which starcat remembers things from one command to the next."""

from __future__ import annotations

import os
from pathlib import Path


def state_folder() -> Path:
    """Return it; it need not be there."""
    state = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(state) / "starcat"
