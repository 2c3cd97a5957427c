"""``python -m starcat``, and the command ``starcat`` of both distributions.

If a library that the command line needs is missing, as in ``starcat-matcher``, only ``identify``
runs. Every other command ends with a message that names what is missing.
"""

from __future__ import annotations

import os
import sys
from contextlib import suppress

from starcat.version import damaged_by_others

INTERRUPTED_CODES = (130, 143)


def main() -> None:
    """Run the command line, or only ``identify`` if libraries are missing."""
    if damaged := damaged_by_others():
        sys.exit(f"starcat: error: {damaged}")
    try:
        from starcat.cli.main import main as run
    except ModuleNotFoundError as lacking:
        from starcat.cli.alone import run_alone

        sys.exit(run_alone(sys.argv[1:], lacking))
    try:
        run()
    except SystemExit as ended:
        if ended.code in INTERRUPTED_CODES:
            # Everything is cleaned up. A thread that still prints would abort Python's own exit.
            with suppress(OSError):
                sys.stdout.flush()
                sys.stderr.flush()
            os._exit(int(ended.code))
        raise


if __name__ == "__main__":
    main()
