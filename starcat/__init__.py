"""starcat: guide-star databases for star trackers, built from star catalogs.

The rooms follow the data: ``catalog`` reads archives and selects guide stars, ``products``
computes what a tracker looks up, ``artifact`` writes and reads the released directory,
``matcher`` identifies stars with it and ``evaluation`` measures how well.
"""

import logging

# A program that wants to see the library's messages sets up logging; the CLI prints its own.
logging.getLogger(__name__).addHandler(logging.NullHandler())

__version__ = "0.1.0"
