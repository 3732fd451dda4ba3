"""The papers' adaptive friction models: coefficients by acceleration class."""
