"""Archives: one module a catalog turns its records into star-table columns."""
