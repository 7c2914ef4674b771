"""The benchmark on scenes by other people: which there are, what denoisers achieve on them, and a blind comparison."""
