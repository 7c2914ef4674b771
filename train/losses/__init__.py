"""The losses of the papers, each with its parameters."""
