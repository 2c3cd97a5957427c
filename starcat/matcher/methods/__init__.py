"""Methods: each module is a way to propose which spot is which star."""
