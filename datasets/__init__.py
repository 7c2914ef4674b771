"""From arrays to disk and back: the channel table, clip shards, the generation job, training sequences."""
