"""Published versions of databases: registries, pulling, pinning."""
