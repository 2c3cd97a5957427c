"""A program's beginning that makes everything impossible to import that the matcher lacks."""

ONLY_NUMPY_AND_H5PY = """
import importlib, sys
class Nothing:
    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        if top not in sys.stdlib_module_names and top not in ("numpy", "h5py", "starcat"):
            raise ImportError(name)
sys.meta_path.insert(0, Nothing())
"""
