"""From arrays to disk and back: the channel table, clips, frames, OpenEXR, and files of other people."""
