"""What tests of scenes share."""

from hypothesis import strategies as st

FRAMES = 24  # of clips
SEEDS = st.integers(0, 2**63)
