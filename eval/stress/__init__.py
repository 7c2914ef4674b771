"""Every denoiser at the extremes, and whether it keeps what is required there."""
