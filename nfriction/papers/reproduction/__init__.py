"""The two papers reproduced on simulated twins of their rigs: every model, table and figure."""
