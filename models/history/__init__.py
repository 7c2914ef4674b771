"""What is carried from frame to frame: G-buffers, reprojection, accumulation, and the scale of a sequence."""
