"""Denoisers on extreme input, and the requirements that they must keep."""
