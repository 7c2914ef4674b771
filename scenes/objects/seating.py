"""What people sit and lie on: chairs, stools, benches, sofas and beds."""

import numpy as np

from scenes.draws import Rng, uniforms
from scenes.meshes import disc, lathe, silhouette, slab, solid, superellipsoid, tube
from scenes.objects.furniture import corners, legs, pedestal
from scenes.objects.thing import SurfacesBySlot, Thing, evenly, shifted, standing, top_support


def back(rng: Rng, width: float, height: float) -> SurfacesBySlot:
    """A chair's back in the xy plane, standing on the origin: posts with slats, spindles or a panel between."""
    post = rng.uniform(0.025, 0.04)
    kind = rng.integers(3)
    wood = [slab(post, height, post).at(x) for x in (post / 2 - width / 2, width / 2 - post / 2)]
    wood.append(slab(width, 0.05, 0.02).at(0, height - 0.05))
    inner = width - 2 * post
    count = int(rng.integers(3, 7))
    if kind == 0:
        wood += [slab(inner, 0.04, 0.015).at(0, y) for y in np.linspace(0.12, height - 0.12, count)]
    elif kind == 1:
        wood += [tube([(x, 0, 0), (x, height - 0.04, 0)], 0.008) for x in evenly(inner, count)]
    else:
        return {"wood": wood, "cushion": [superellipsoid(inner, height - 0.15, 0.05, 5).at(0, 0.08)]}
    return {"wood": wood}


def make_chair(rng: Rng) -> Thing:
    width, depth, height = uniforms(rng, (0.4, 0.5), (0.4, 0.5), (0.4, 0.47))
    is_soft = rng.random() >= 0.5
    thickness = rng.uniform(0.05, 0.09) if is_soft else rng.uniform(0.02, 0.04)
    seat = {"wood": [slab(width, 0.02 if is_soft else thickness, depth)]}
    if is_soft:
        seat["cushion"] = [superellipsoid(width, thickness - 0.01, depth, 6).at(0, 0.01)]
    frame = legs(rng, width, depth, height)
    rest = shifted(back(rng, width, rng.uniform(0.35, 0.6)), y=height + 0.01, z=0.025 - depth / 2)
    low = (0.05 - width / 2, height + thickness, 0.08 - depth / 2)
    free = np.array([low, (width / 2 - 0.05, np.inf, depth / 2 - 0.05)])
    return standing("chair", frame, shifted(seat, y=height), rest, supports=[free])


def make_stool(rng: Rng) -> Thing:
    """A round stool; without a cushion it carries things."""
    radius, height = uniforms(rng, (0.15, 0.22), (0.42, 0.75))
    side = radius * np.sqrt(2)
    frame = pedestal(rng, radius, height) if rng.random() < 0.3 else legs(rng, side, side, height)
    board = {"wood": [disc(radius, 0.03).at(0, height)]}
    if rng.random() < 0.4:
        thickness = rng.uniform(0.05, 0.1)
        cushion = lathe(solid(silhouette([radius * 0.9, radius, radius, radius * 0.9], thickness, 10)))
        return standing("stool", frame, board, {"cushion": [cushion.at(0, height + 0.03)]})
    return standing("stool", frame, board, supports=[top_support(side, side, height + 0.03)])


def make_bench(rng: Rng) -> Thing:
    width, depth, height = uniforms(rng, (0.8, 1.6), (0.3, 0.42), (0.4, 0.48))
    count = int(rng.integers(1, 6))
    thickness = rng.uniform(0.02, 0.045)
    planks = [slab(width, thickness, depth / count - 0.008).at(0, height, z) for z in evenly(depth, count)]
    free = top_support(width, depth, height + thickness)
    return standing("bench", {"wood": planks}, legs(rng, width, depth, height), supports=[free])


def upholstered(rng: Rng, name: str, seats: int) -> Thing:
    """A sofa with that many seats; one makes an armchair."""
    place, depth, foot, arm = uniforms(rng, (0.55, 0.75), (0.75, 0.95), (0.04, 0.16), (0.1, 0.22))
    soft = rng.uniform(3, 9)
    level = foot + rng.uniform(0.2, 0.28)
    rise, lean = uniforms(rng, (0.35, 0.55), (0.05, 0.25))
    inner = seats * place
    width = seats * place + 2 * arm
    side = superellipsoid(arm, level + rng.uniform(0.12, 0.22) - foot, depth, soft)
    body = [
        superellipsoid(width - arm, level - foot, depth * 0.96, 9).at(0, foot),
        superellipsoid(inner + arm, level + rise - foot - 0.06, 0.22, soft, 3).at(0, foot, 0.11 - depth / 2),
        side.at(-(inner + arm) / 2, foot),
        side.at((inner + arm) / 2, foot),
    ]
    cushion = superellipsoid(place - 0.01, 0.16, depth - 0.26, soft)
    rest = superellipsoid(place - 0.03, rise, 0.2, rng.uniform(2.5, 5)).turned(-lean, axis=0)
    pair = [cushion.at(0, level - 0.04, 0.11), rest.at(0, level + 0.1, 0.3 - depth / 2)]
    cushions = [part.at(x) for x in evenly(inner, seats) for part in pair]
    leg = lathe(solid([(0.02, 0), (0.03, foot + 0.03)]), 12)
    feet = [leg.at(x, 0, z) for x, z in corners(width - 0.12, depth - 0.12)]
    return standing(name, {"fabric": body, "cushion": cushions, "wood": feet})


def make_sofa(rng: Rng) -> Thing:
    return upholstered(rng, "sofa", int(rng.integers(2, 4)))


def make_armchair(rng: Rng) -> Thing:
    return upholstered(rng, "armchair", 1)


def make_bed(rng: Rng) -> Thing:
    """A bed with its head towards -z: frame, mattress, blanket and one or two pillows."""
    width, depth, level, thickness = uniforms(rng, (0.9, 1.8), (1.95, 2.15), (0.22, 0.4), (0.15, 0.26))
    frame = [slab(width + 0.06, 0.1, depth + 0.06).at(0, level - 0.1)]
    frame.append(slab(width + 0.06, level + rng.uniform(0.4, 0.8), 0.05).at(0, 0, -depth / 2 - 0.05))
    frame += [slab(0.08, level - 0.1, 0.08).at(x, 0, z) for x, z in corners(width - 0.1, depth - 0.1)]
    cover = rng.uniform(0.5, 0.75) * depth
    blanket = superellipsoid(width + 0.04, thickness + 0.02, cover, 9, 3)
    blanket = blanket.at(0, level + 0.02, (depth - cover) / 2 + 0.02)
    count = 1 if width < 1.3 else 2
    pillow = superellipsoid(width / count - 0.1, 0.13, 0.4, rng.uniform(2.5, 4)).turned(0.15, axis=0)
    pillows = [pillow.at(x, level + thickness - 0.02, 0.28 - depth / 2) for x in evenly(width, count)]
    mattress = superellipsoid(width, thickness, depth, 16, 3).at(0, level)
    return standing("bed", {"wood": frame, "fabric": [mattress], "blanket": [blanket], "cushion": pillows})


SEATS = (make_chair, make_stool, make_bench)
UPHOLSTERED = (make_sofa, make_armchair, make_bed)
