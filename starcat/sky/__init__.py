"""The real sky: where its bodies are, how motion turns starlight, what its stars are called."""
