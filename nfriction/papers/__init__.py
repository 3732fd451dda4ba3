"""The two papers' own methods; nothing of the core imports them."""
