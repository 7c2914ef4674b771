"""Other renderers' frames: read, understood, denoised and written."""
