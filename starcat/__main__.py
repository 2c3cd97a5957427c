"""``python -m starcat``, and the command ``starcat`` of both distributions.

Where a library of the command line is missing, or the whole of it as in ``starcat-matcher``, what
there is identifies, and says of the rest what is lacking.
"""

from __future__ import annotations

import os
import sys
from contextlib import suppress

from starcat.version import damaged_by_others

INTERRUPTED_CODES = (130, 143)


def main() -> None:
    """Run the command line, or what there is of it."""
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
            # All is cleaned up. A thread that still prints would abort what Python does at its end.
            with suppress(OSError):
                sys.stdout.flush()
                sys.stderr.flush()
            os._exit(int(ended.code))
        raise


if __name__ == "__main__":
    main()
