"""From an animated scene and a frame number to arrays: camera, G-buffer, motion, path-traced radiance."""
