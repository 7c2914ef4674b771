"""What the name of a clip says about it."""

import re
from typing import NamedTuple

from errors import BadInput


class ClipKind(NamedTuple):
    """What a clip's name says: 000 is a number, in `still` nothing moves, 000-4spp has noisy input of 4 spp."""

    number: int
    still: bool
    noisy_spp: int  # samples a pixel of the noisy channels

    @staticmethod
    def of(name: str) -> "ClipKind":
        """The kind of the clip of that name. Raises BadInput where no clip is called so."""
        match = re.fullmatch(r"(\d+|still)(?:-(\d+)spp)?", name)
        if not match:
            raise BadInput(f"'{name}' does not name a clip: clips are called 000, still or 000-4spp")
        still = match[1] == "still"
        return ClipKind(0 if still else int(match[1]), still, int(match[2] or 1))
