"""Denoisers without a network, and OIDN."""
