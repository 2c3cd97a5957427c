"""Published versions of artifacts: registries, pulling, pinning."""
