"""The real sky: where its bodies are, how motion turns starlight, what its stars are called."""

from starcat.rooms import lazy_names

__getattr__ = lazy_names(__name__, __file__)
