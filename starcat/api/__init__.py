"""The public interface, ``import starcat``: thin functions and classes over the other packages."""
