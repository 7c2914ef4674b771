"""From a noisy frame and a state to a denoised image."""
