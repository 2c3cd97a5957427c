"""SQL over databases and catalogs."""
