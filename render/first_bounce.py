"""What a pixel's sample draws at the surface that the pixel shows, drawn again to see what its rays meet."""

# In Mitsuba's stubs mi.Float and mi.Bool are other classes than those that its functions take and return.
# mypy: disable-error-code="arg-type, call-overload, operator"

from typing import NamedTuple

from render.backend import dr, mi
from render.path import PathTracer
from render.sampler import hash32
from scenes.camera import View


class FirstBounce(NamedTuple):
    """Of a sample at each pixel. No ray has been traced but the primary one."""

    si: mi.SurfaceInteraction3f  # what the pixel shows
    light: mi.DirectionSample3f  # the point of a light that next-event estimation has chosen
    radiance: mi.Color3f  # what that sends here, over the density of the choice, if nothing stands between
    endless: mi.Bool  # whether the light is infinitely far away
    faces: mi.Bool  # whether the surface reflects light from there to the eye
    sample: mi.BSDFSample3f  # the direction in which the path goes on


def first_bounce(tracer: PathTracer, view: View, seed: int, index: int) -> FirstBounce:
    """The sample of that index of those that `tracer.radiance` draws with this seed.

    The stage must be posed for `view`'s frame.
    """
    stage = tracer.stage
    si = stage.mitsuba_scene.ray_intersect(stage.rays(view), mi.RayFlags.All, coherent=True)
    key = hash32(hash32(tracer.every_pixel) ^ dr.opaque(mi.UInt32, seed))
    sampler = tracer.draw(key, dr.opaque(mi.UInt32, index), mi.UInt32(1))
    u_emitter = sampler.next_2d()
    u_lobe = sampler.next_1d()
    u_direction = sampler.next_2d()

    bsdf = si.bsdf()
    smooth = si.is_valid() & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
    light, radiance = stage.lights.sample_direction(si, u_emitter, smooth)
    endless = mi.has_flag(light.emitter.flags(), mi.EmitterFlags.Infinite)
    faces = smooth & (light.pdf != 0) & (si.to_local(light.d).z * si.wi.z > 0)
    sample, _ = bsdf.sample(mi.BSDFContext(), si, u_lobe, u_direction, si.is_valid())
    return FirstBounce(si, light, radiance, endless, faces, sample)
