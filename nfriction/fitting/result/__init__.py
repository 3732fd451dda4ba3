"""Results of fits, and how certain they are."""
