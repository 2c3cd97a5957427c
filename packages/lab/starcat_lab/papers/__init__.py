"""The five papers: what each printed, and the experiments and numbers that measure the same."""
