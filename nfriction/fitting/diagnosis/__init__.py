"""Mistakes in recordings and rigs, and changes with time, found without a simulation."""
