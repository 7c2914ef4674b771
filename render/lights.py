"""The lights of a scene, chosen evenly. How many there are enters kernels as data."""

# In Mitsuba's stubs mi.Float and mi.Bool are other classes than those that its functions take and return.
# mypy: disable-error-code="arg-type, assignment, operator, return-value"

from typing import ClassVar

from render.backend import dr, mi


class Lights:
    """All emitters of a Mitsuba scene.

    As Mitsuba's own `Scene.sample_emitter_direction`, `pdf_emitter_direction` and `SurfaceInteraction3f.emitter`, which
    compile these numbers into every kernel.
    """

    DRJIT_STRUCT: ClassVar = {"emitters": mi.EmitterPtr, "count": mi.UInt32}

    def __init__(self, scene: mi.Scene | None = None):
        if scene is None:  # Dr.Jit makes empty ones
            return
        emitters = scene.emitters()
        # The sky once more behind them all: a pointer of its own would be compiled in, and so would a single entry.
        self.emitters = mi.EmitterPtr([*emitters, scene.environment(), None])
        self.count = mi.UInt32(len(emitters))
        dr.make_opaque(self.emitters, self.count)

    def sample_direction(
        self, si: mi.SurfaceInteraction3f, u: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.DirectionSample3f, mi.Color3f]:
        """A direction to a light, and radiance over the density of the choice. Nothing is tested for visibility."""
        scaled = u.x * mi.Float(self.count)
        index = dr.minimum(mi.UInt32(scaled), self.count - 1)
        active = active & (self.count > 0)
        emitter = dr.gather(mi.EmitterPtr, self.emitters, index, active)
        light, weight = emitter.sample_direction(si, mi.Point2f(scaled - mi.Float(index), u.y), active)
        light.pdf = light.pdf / mi.Float(self.count)
        return light, weight * mi.Float(self.count)

    def pdf_direction(self, si: mi.SurfaceInteraction3f, light: mi.DirectionSample3f, active: mi.Bool) -> mi.Float:
        """The density with which `sample_direction` chooses a direction that leads to a light."""
        return light.emitter.pdf_direction(si, light, active) / mi.Float(self.count)

    def at(self, si: mi.SurfaceInteraction3f) -> mi.EmitterPtr:
        """The light that shines at `si`, the sky's where nothing is hit; none elsewhere."""
        sky = dr.gather(mi.EmitterPtr, self.emitters, self.count)
        return dr.select(si.is_valid(), si.shape.emitter(), sky)
