"""The windows of an image with most disocclusions."""

from typing import NamedTuple

from torch import Tensor
from torch.nn.functional import avg_pool2d

SMALLEST_CROP = 16  # px
CROPS_A_SIDE = 4  # a crop is a quarter of the image's shorter side


class Crop(NamedTuple):
    """A square of an image, in pixels, and how many disoccluded pixels it contains."""

    x: int
    y: int
    size: int
    pixels: int


def densest_crop(mask: Tensor) -> Crop | None:
    """The window with most pixels of a mask (H, W), centred on them within the image; None for an empty mask."""
    height, width = mask.shape
    shorter = min(height, width)
    size = min(shorter, max(SMALLEST_CROP, shorter // CROPS_A_SIDE))
    best = int(avg_pool2d(mask[None, None].double(), size, stride=1).argmax())
    y, x = divmod(best, width - size + 1)
    inside = mask[y : y + size, x : x + size].nonzero().double()
    if not len(inside):
        return None
    dy, dx = (inside.mean(dim=0) - (size - 1) / 2).round().int().tolist()
    y = min(max(0, y + dy), height - size)
    x = min(max(0, x + dx), width - size)
    return Crop(x, y, size, int(mask[y : y + size, x : x + size].sum()))
