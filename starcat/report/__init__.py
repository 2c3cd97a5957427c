"""The report of a build: tables, plots and one page, the same bytes for the same build."""
