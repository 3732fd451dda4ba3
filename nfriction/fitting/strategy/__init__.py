"""Order of searches: horizons, starts, hold-out."""
