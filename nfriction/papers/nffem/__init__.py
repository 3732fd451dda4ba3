"""The papers' neuro-fuzzy friction models and their training."""
