"""The integrator `onespp_guides`: the light of another integrator, and guides for a denoiser along the same rays.

Classes of integrators belong to a variant: this module is loaded anew when the variant changes.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from .bsdfs import Surfaces, registry_index
from .camera import Camera, camera_of
from .colours import is_scalar, radiance_of, to_rgb
from .sight import Sight, look_through

AXES = {"albedo": "RGB", "emission": "RGB", "normal": "XYZ", "depth": "T", "roughness": "Y", "shape": "I"}
AXES["primitive"] = "I"
# Light of a surface is less than its emission by rounding alone; otherwise the nested integrator hides it.
ALMOST_ALL = 0.9999


class Viewer(NamedTuple):
    """Where rays come from: they start in front of the eye, at the near plane."""

    eye: Any
    forward: Any  # the viewing axis
    focal: Any  # length in pixels

    @staticmethod
    def of(camera: Camera) -> "Viewer":
        """As data: literals would be compiled into kernels, anew for each frame."""
        axis, eye = (list(map(float, camera.camera_to_world[:3, column])) for column in (2, 3))
        viewer = Viewer(mi.Point3f(eye), mi.Vector3f(axis), mi.Float(abs(float(camera.K[0, 0]))))
        dr.make_opaque(viewer)
        return viewer


class Sample(NamedTuple):
    """What a ray finds."""

    light: Any  # Spectrum of the nested integrator, with emission
    emitted: Any  # Spectrum, the part of it that is known without noise
    valid: Any
    guides: dict[str, Any]
    others: list[Any]  # AOVs of the nested integrator

    def aovs(self) -> list[Any]:
        ours = [self.guides[name] for name in AXES]
        return [*(part for value in ours for part in components(value)), *self.others]


def components(value: Any) -> list[Any]:
    return list(value) if dr.depth_v(value) > dr.depth_v(mi.Float) else [value]


class GuidesIntegrator(mi.SamplingIntegrator):
    """Parameters: a nested SamplingIntegrator, without which there is emission alone, and `look_through` (true).

    Every ray passes through the centre of its pixel, so that guides are free of noise and fit the light: images are not
    antialiased, and filters of films are not used. Guides describe first hits or, with `look_through`, what mirrors and
    smooth glass show, as if it stood behind them.

    - albedo: diffuse reflectance + specular reflectance at normal incidence, linear sRGB; 1 for background
    - emission: radiance of lamps and sky seen directly or in perfect mirrors, linear sRGB, which the image includes
    - normal: shading normal in world space, of length 1, towards the viewer; 0 for background
    - depth: distance along the viewing axis; 0 for background
    - roughness: GGX alpha; 1 for diffuse surfaces and background
    - shape: index in `scene.shapes()` + 1; 0 for background
    - primitive: index in the shape + 1; 0 for background and behind mirrors

    Textures may change; numbers of BSDFs are read once for a scene.

    Raises ValueError for nested objects other than one such integrator; when rendering, for sensors that are no
    pinholes, and for films that are no hdrfilm.
    """

    def __init__(self, props: Any):
        super().__init__(props)
        nested = [each for _, each in props.objects()]
        if len(nested) > 1 or not all(isinstance(each, mi.SamplingIntegrator) for each in nested):
            found = ", ".join(each.class_name() for each in nested)
            raise ValueError(f"onespp_guides: expected one nested integrator that samples rays, as path; got {found}")
        self.nested = nested[0] if nested else None
        self.looks_through = props.get("look_through", True)
        self.scene: Any = None  # that `surfaces` and `shapes` are of

    def aov_names(self) -> list[str]:
        ours = [f"{name}.{axis}" for name, axes in AXES.items() for axis in axes]
        return ours + (self.nested.aov_names() if self.nested else [])

    def traverse(self, callback: Any) -> None:
        if self.nested:
            callback.put("nested", self.nested, mi.ParamFlags.Differentiable)

    def to_string(self) -> str:
        return f"GuidesIntegrator[look_through = {self.looks_through}, nested = {self.nested}]"

    def read(self, scene: Any) -> None:
        """Prepare for a scene, unless it is the one before."""
        if scene is self.scene:
            return
        self.scene, self.surfaces, shapes = scene, Surfaces(scene), scene.shapes()
        if is_scalar():
            self.shapes: Any = {shape.ptr: number for number, shape in enumerate(shapes, 1)}
            return
        numbers = [int(registry_index(mi.ShapePtr(shape))[0]) for shape in shapes]
        table = [0] * (max(numbers, default=0) + 1)
        for index, number in enumerate(numbers, 1):
            table[number] = index
        self.shapes = mi.UInt32(table)
        dr.make_opaque(self.shapes)

    def shape_at(self, si: Any) -> Any:
        """The number of the shape, or of the instance that it belongs to; 0 for none."""
        if is_scalar():
            shape = (si.instance or si.shape) if si.is_valid() else None
            return mi.Float(self.shapes[shape.ptr] if shape else 0)
        instance = registry_index(si.instance)
        shape = dr.select(instance != 0, instance, registry_index(si.shape))
        return mi.Float(dr.gather(mi.UInt32, self.shapes, shape, si.is_valid()))

    def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True) -> Any:
        """(light, whether there is a surface, AOVs), as Mitsuba asks for; depth is along the ray."""
        found = self.trace(scene, sampler, ray, Viewer(ray.o, ray.d, mi.Float(0)), active)
        return found.light, found.valid, found.aovs()

    def trace(self, scene: Any, sampler: Any, ray: Any, viewer: Viewer, active: Any = True) -> Sample:
        self.read(scene)
        first = Sight.along(scene, ray, active)
        seen = look_through(scene, self.surfaces, first, viewer.eye, viewer.focal) if self.looks_through else first
        hit, is_first = first.si.is_valid(), seen.beyond == 0
        guides = self.surface_guides(seen)
        depth = dr.dot(first.si.p - viewer.eye, viewer.forward) + seen.beyond * dr.dot(ray.d, viewer.forward)
        guides["depth"] = dr.select(hit, depth, 0)
        guides["primitive"] = dr.select(hit & is_first, mi.Float(first.si.prim_index) + 1, 0)
        throughput = dr.select(is_first, mi.Color3f(1), mi.Color3f(0) if mi.is_spectral else seen.throughput)
        emitted, emission = emission_of(scene, seen.si, throughput)
        light, valid, others = emitted, hit, []
        if self.nested:
            light, valid, others = self.nested.sample(scene, sampler, mi.RayDifferential3f(ray), None, active)
        shown = dr.all(mi.unpolarized_spectrum(light) >= ALMOST_ALL * mi.unpolarized_spectrum(emitted))
        guides["emission"] = dr.select(shown, emission, mi.Color3f(0))
        return Sample(light, dr.select(shown, emitted, mi.Spectrum(0)), valid, guides, others)

    def surface_guides(self, seen: Sight) -> dict[str, Any]:
        albedo, alpha, normal = self.surfaces.at(seen.si)
        normal = dr.select(dr.dot(normal, seen.ray.d) > 0, -normal, normal)
        turned = mi.Vector3f(dr.dot(seen.x, normal), dr.dot(seen.y, normal), dr.dot(seen.z, normal))
        shape = self.shape_at(seen.si)
        return {"albedo": seen.tint * albedo, "normal": turned, "roughness": alpha, "shape": shape}

    def render(
        self, scene: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0, develop: bool = True, evaluate: bool = True
    ) -> Any:
        """The image (H, W, C) of the film's channels and AOVs; as of any integrator."""
        sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        camera, film = camera_of(sensor), sensor.film()
        if mi.has_flag(film.flags(), mi.FilmFlags.Special):
            raise ValueError(f"film: expected hdrfilm, got {film.class_name()}")
        film.prepare(self.aov_names())
        sampler = sensor.sampler().clone()
        if spp:
            sampler.set_sample_count(spp)
        viewer = Viewer.of(camera)
        block, has_alpha = pixel_block(film), mi.has_flag(film.flags(), mi.FilmFlags.Alpha)
        for pixel in pixels_of(sampler, camera.size, seed):
            position, ray, weight = centre_ray(sensor, sampler, pixel, camera.size[1])
            found = self.trace(scene, sampler, ray, viewer)
            colour = to_rgb((found.light - found.emitted) * weight, ray.wavelengths) + found.guides["emission"]
            alpha = [dr.select(found.valid, mi.Float(1), mi.Float(0))] if has_alpha else []
            block.put(position, [*components(colour), *alpha, mi.Float(1), *found.aovs()])
        film.put_block(block)
        image = film.develop() if develop else mi.TensorXf()
        if evaluate:
            dr.eval(image)
            film.schedule_storage()
        return image


def emission_of(scene: Any, si: Any, throughput: Any) -> tuple[Any, Any]:
    """(Spectrum at the wavelengths of `si`, Color3f without noise) of what the surface, or the sky, emits."""
    emitter = si.emitter(scene)
    if emitter is None:  # of scalar variants
        return mi.Spectrum(0), mi.Color3f(0)
    by_spectrum = throughput if mi.is_rgb else throughput.x
    return emitter.eval(si) * by_spectrum, radiance_of(emitter.eval, si) * throughput


def pixel_block(film: Any) -> Any:
    """A block in which each sample counts for its own pixel alone, whatever the film's filter."""
    channels, box = film.create_block().channel_count(), mi.load_dict({"type": "box"})
    # Normals are negative, which is no reason to warn.
    return mi.ImageBlock(film.crop_size(), film.crop_offset(), channels, box, warn_negative=False, warn_invalid=False)


def pixels_of(sampler: Any, size: tuple[int, int], seed: Any) -> Iterator[Any]:
    """The index of the pixel of each sample: all at once, or one by one in scalar variants."""
    count, spp = size[0] * size[1], sampler.sample_count()
    if not is_scalar():
        sampler.set_samples_per_wavefront(spp)
        sampler.seed(seed, count * spp)
        yield dr.arange(mi.UInt32, count * spp) // spp
        return
    for pixel in range(count):
        sampler.seed((seed * count + pixel) & 0xFFFFFFFF)
        for _ in range(spp):
            yield pixel
            sampler.advance()


def centre_ray(sensor: Any, sampler: Any, pixel: Any, width: int) -> tuple[Any, Any, Any]:
    """(position on the film, ray, weight) of a sample."""
    film = sensor.film()
    centre: Any = mi.Point2f(mi.Float(pixel % width) + 0.5, mi.Float(pixel // width) + 0.5)
    wavelength = sampler.next_1d() if mi.is_spectral else mi.Float(0.5)
    within = centre / mi.ScalarVector2f(film.crop_size())
    ray, weight = sensor.sample_ray(sensor.shutter_open(), wavelength, within, mi.Point2f(0.5))
    return centre + mi.ScalarVector2f(film.crop_offset()), ray, weight


mi.register_integrator("onespp_guides", GuidesIntegrator)
