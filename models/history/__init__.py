"""What is carried from frame to frame: reprojection, accumulation, and the scale of a sequence."""
