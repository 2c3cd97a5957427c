"""The report of an evaluation: tables, plots and a page."""
