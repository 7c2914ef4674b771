"""What may be put around a denoiser: +adaptive, +taa, +js."""
