"""Long work: what was asked for, who does it, and what became of it."""
