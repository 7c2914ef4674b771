"""Other people's scenes: read safely, and what cannot be honoured said in plain words."""
