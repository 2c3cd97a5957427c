"""``python -m starcat``: the same as the command ``starcat``."""

from starcat.cli.main import main

main()
