"""Star tables: their columns, the motions of stars, and the verdicts on records."""
