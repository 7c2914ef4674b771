"""Wrappers of denoisers: +adaptive, +taa, +js."""
