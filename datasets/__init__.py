"""From arrays to disk and back: the channel table, clips, the generation job and training sequences."""
