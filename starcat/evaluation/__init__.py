"""Room 5: simulated skies, and how often and how well they are identified."""
