"""Archives: one module per catalog converts its records to star-table columns."""
