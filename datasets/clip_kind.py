"""What the name of a clip says of it."""

import re
from typing import NamedTuple

from errors import BadInput


class ClipKind(NamedTuple):
    """What a clip's name says: a number; `still`, in which nothing moves; 000-4spp, with 4 spp as noisy input."""

    number: int
    still: bool
    noisy_spp: int

    @staticmethod
    def of(name: str) -> "ClipKind":
        """Raises BadInput for a name that is none."""
        match = re.fullmatch(r"(\d+|still)(?:-(\d+)spp)?", name)
        if not match:
            raise BadInput(f"'{name}' does not name a clip: clips are called 000, still or 000-4spp")
        still = match[1] == "still"
        return ClipKind(0 if still else int(match[1]), still, int(match[2] or 1))
