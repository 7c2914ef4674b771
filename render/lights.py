"""Uniform choice among the lights of a scene, whose number enters kernels as data."""

from typing import ClassVar

from render.backend import dr, mi


class Lights:
    """All emitters of a Mitsuba scene.

    Equivalent to Mitsuba's `Scene.sample_emitter_direction` and `SurfaceInteraction3f.emitter`, which compile the
    number of emitters into every kernel.
    """

    DRJIT_STRUCT: ClassVar = {"emitters": mi.EmitterPtr, "count": mi.UInt32, "odds": mi.Float}

    def __init__(self, scene: mi.Scene | None = None):
        if scene is None:  # Dr.Jit creates empty instances
            return
        emitters = scene.emitters()
        # The sky again at the end: a pointer of its own would be compiled in, and so would a single entry.
        self.emitters = mi.EmitterPtr([*emitters, scene.environment(), None])
        self.count = mi.UInt32(len(emitters))
        dr.make_opaque(self.emitters, self.count)
        self.sample_rarely(1)

    def sample_rarely(self, rarity: float) -> None:
        """Sample lights `rarity` (>= 1) times more rarely, each once in `odds` samples.

        The mean stays, and noise becomes that of scenes in which light is hard to find.
        """
        self.odds = mi.Float(self.count) * rarity
        dr.make_opaque(self.odds)

    def sample_direction(
        self, si: mi.SurfaceInteraction3f, u: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.DirectionSample3f, mi.Color3f]:
        """A direction to a light, and radiance over the density of the choice, without a test of visibility."""
        scaled = u.x * self.odds
        index = mi.UInt32(scaled)
        active = active & (index < self.count)
        emitter = dr.gather(mi.EmitterPtr, self.emitters, index, active)
        light, weight = emitter.sample_direction(si, mi.Point2f(scaled - mi.Float(index), u.y), active)
        light.pdf = light.pdf / self.odds
        return light, weight * self.odds

    def at(self, si: mi.SurfaceInteraction3f) -> mi.EmitterPtr:
        """The emitter at `si`, the sky where nothing is hit; none elsewhere."""
        sky = dr.gather(mi.EmitterPtr, self.emitters, self.count)
        return dr.select(si.is_valid(), si.shape.emitter(), sky)
