"""Methods: one module a way to propose which spot is which star."""
