"""The ablations of the papers, trained and judged here."""
