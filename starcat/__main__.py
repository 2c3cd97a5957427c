"""``python -m starcat``: the same as the command ``starcat``."""

from starcat.cli import main

main()
