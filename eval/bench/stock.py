"""Stock Mitsuba with its `path` integrator and `independent` sampler, on a frame of onespp."""

from collections.abc import Callable
from typing import Any

import numpy as np

from render.backend import mi
from render.path import FloatImage, PosedFrame, finite_or_zero
from render.stage import Stage
from scenes.camera import View

Render = Callable[[int, int], FloatImage]  # (seed, samples a pixel) to radiance (H, W, 3)


def stock_sensor(stage: Stage, view: View) -> Any:
    """Mitsuba's own perspective sensor for a view."""
    x_fov = np.degrees(2 * np.arctan(stage.width / 2 / -view.K[0, 0]))
    to_world = view.camera_to_world.copy()
    to_world[:3, 3] /= stage.unit
    description = {
        "type": "perspective",
        "fov": float(x_fov),
        "near_clip": 1e-3,
        "far_clip": 1e5,
        "to_world": mi.ScalarTransform4f(to_world.astype(np.float32)),
        "film": {"type": "hdrfilm", "width": stage.width, "height": stage.height, "rfilter": {"type": "box"}},
    }
    return mi.load_dict(description)


def stock_render(posed: PosedFrame) -> Render:
    """`mi.render` for a frame: radiance with emission; pixels that are not finite are 0."""
    integrator = mi.load_dict({"type": "path", "max_depth": posed.stage.scene.max_depth})
    sensor = stock_sensor(posed.stage, posed.view)

    def render(seed: int, spp: int) -> FloatImage:
        scene = posed.stage.mitsuba_scene
        image = mi.render(scene, sensor=sensor, integrator=integrator, seed=mi.UInt32(seed), spp=spp)
        return finite_or_zero(np.array(image))

    return render
