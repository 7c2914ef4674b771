"""Things of clear glass: showcases, standing panes, and mirrors behind a pane."""

from scenes.draws import Rng, one_of, uniforms
from scenes.meshes import slab
from scenes.objects.furniture import rim
from scenes.objects.thing import Thing, assembled, standing, top_support

EDGE = 0.03  # m, a frame's width


def make_showcase(rng: Rng) -> Thing:
    """A plinth with panes at its front and sides, open above, before a board or a mirror."""
    width, height, depth, tall = uniforms(rng, (0.6, 1.4), (0.5, 0.9), (0.35, 0.55), (0.35, 0.8))
    thickness = rng.uniform(0.004, 0.012)
    panes = [slab(width - 0.01, tall, thickness).at(0, height + 0.001, depth / 2 - thickness)]
    panes += [
        slab(thickness, tall, depth - 0.08).at(side * (width / 2 - thickness), height + 0.001, -0.01)
        for side in (-1, 1)
    ]
    back = slab(width, tall, 0.02).at(0, height + 0.001, 0.01 - depth / 2)
    surfaces = {"wood": [slab(width, height, depth)], "clear": panes, one_of(rng, ("front", "mirror")): [back]}
    inside = top_support(width - 0.06, depth - 0.1, height, margin=0.02)
    return standing("showcase", surfaces, [inside])


def make_pane(rng: Rng) -> Thing:
    """A pane in a frame that stands by itself, as in offices."""
    width, height, thickness = uniforms(rng, (0.7, 1.6), (1.2, 2.0), (0.004, 0.012))
    frame = rim(width, height, EDGE, EDGE)
    feet = [slab(EDGE, 0.02, 0.4).at(side * width / 3) for side in (-1, 1)]
    pane = slab(width - 2 * EDGE - 0.002, height - 2 * EDGE - 0.002, thickness).at(0, EDGE + 0.021)
    surfaces = {"metal": [*(board.at(0, 0.02) for board in frame), *feet], "clear": [pane]}
    return standing("pane", surfaces)


def make_glazed_mirror(rng: Rng) -> Thing:
    """A framed mirror behind a pane for a wall: its back at z = 0, facing +z."""
    width, height, gap = uniforms(rng, (0.4, 1.1), (0.5, 1.2), (0.01, 0.03))
    inside = width - 2 * EDGE - 0.002, height - 2 * EDGE - 0.002
    frame = [board.at(z=0.02 + gap / 2) for board in rim(width, height, EDGE, 0.04 + gap)]
    mirror = slab(*inside, 0.004).at(0, EDGE + 0.001, 0.003)
    pane = slab(*inside, 0.004).at(0, EDGE + 0.001, 0.007 + gap)
    return assembled("glazed_mirror", {"frame": frame, "mirror": [mirror], "clear": [pane]})
