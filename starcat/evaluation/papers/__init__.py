"""The five papers: what each printed, and the trials and numbers that measure the same."""
