"""The two papers' own methods; the core does not import them."""
