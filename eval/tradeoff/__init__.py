"""Quality against milliseconds, by denoiser, precision and samples per pixel."""
