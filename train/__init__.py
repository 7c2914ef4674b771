"""Losses, recipes, and one training loop for all networks."""
