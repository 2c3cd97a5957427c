"""Long work: requests for jobs, the processes and workers that do them, and their results."""
