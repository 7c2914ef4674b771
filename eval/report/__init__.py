"""One page of all results, and an animation of each clip."""
