"""Denoisers with a network, and the layers they are built from."""
