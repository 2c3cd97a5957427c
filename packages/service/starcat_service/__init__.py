"""The service: databases built, queried and shipped from a browser, TOPCAT or a script."""
