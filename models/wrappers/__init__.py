"""Wrappers of denoisers: +accumulated, +adaptive, +taa, +js."""
