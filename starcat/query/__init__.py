"""SQL over artifacts and catalogs."""
