"""Uniform choice among the lights of a scene, whose number enters kernels as data."""

from typing import ClassVar

from render.backend import dr, mi


class Lights:
    """All emitters of a Mitsuba scene.

    Equivalent to Mitsuba's `Scene.sample_emitter_direction` and `SurfaceInteraction3f.emitter`, which compile the
    number of emitters into every kernel.
    """

    DRJIT_STRUCT: ClassVar = {"emitters": mi.EmitterPtr, "count": mi.UInt32}

    def __init__(self, scene: mi.Scene | None = None):
        if scene is None:  # Dr.Jit creates empty instances
            return
        emitters = scene.emitters()
        # The sky again at the end: a pointer of its own would be compiled in, and so would a single entry.
        self.emitters = mi.EmitterPtr([*emitters, scene.environment(), None])
        self.count = mi.UInt32(len(emitters))
        dr.make_opaque(self.emitters, self.count)

    def sample_direction(
        self, si: mi.SurfaceInteraction3f, u: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.DirectionSample3f, mi.Color3f]:
        """A direction to a light, and radiance over the density of the choice, without a test of visibility."""
        scaled = u.x * mi.Float(self.count)
        index = dr.minimum(mi.UInt32(scaled), self.count - 1)
        active = active & (self.count > 0)
        emitter = dr.gather(mi.EmitterPtr, self.emitters, index, active)
        light, weight = emitter.sample_direction(si, mi.Point2f(scaled - mi.Float(index), u.y), active)
        light.pdf = light.pdf / mi.Float(self.count)
        return light, weight * mi.Float(self.count)

    def at(self, si: mi.SurfaceInteraction3f) -> mi.EmitterPtr:
        """The emitter at `si`, the sky where nothing is hit; none elsewhere."""
        sky = dr.gather(mi.EmitterPtr, self.emitters, self.count)
        return dr.select(si.is_valid(), si.shape.emitter(), sky)
