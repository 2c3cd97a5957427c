"""The five papers: their printed results, and the experiments and numbers that measure the same."""
