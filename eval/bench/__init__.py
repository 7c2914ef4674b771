"""Benches: what a frame, a sample, a training step and a batch cost on this machine."""
