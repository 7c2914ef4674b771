"""Primary visibility without noise, directly and by way of mirrors and glass: geometry, materials and emission."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from datasets.channels import BACKGROUND, MIRRORED, SECOND
from render.backend import dr, mi
from render.loading import columns
from render.look_through import Sight, look_through, surface_channels
from render.materials import is_in
from render.specular_light import specular_light
from render.stage import Stage
from scenes.camera import Array, View

Arrays = dict[str, NDArray[Any]]  # channels of one frame by name


def depth_along_axis(stage: Stage, length: mi.Float, ray: mi.Ray3f, view: View) -> NDArray[np.float32]:
    """Depth (N,) along the viewing axis, in world units; 0 where nothing is hit. float32, as stored.

    `length` is that of the path in Mitsuba's units, 0 where nothing is hit.
    """
    distance = np.array(length, dtype=np.float64) * stage.unit
    depth = distance * (columns(ray.d).astype(np.float64) @ view.camera_to_world[:3, 2])
    if stage.has_cutouts:  # rays begin behind those that they have passed
        begins = columns(ray.o).astype(np.float64) * stage.unit - view.camera_to_world[:3, 3]
        depth += np.where(distance > 0, begins @ view.camera_to_world[:3, 2], 0)
    return depth.astype(np.float32)


class VisibleSurface(NamedTuple):
    depth: Array  # (...,), along the viewing axis; 0 for background
    mesh_id: NDArray[np.uint32]  # (...,), 0 for background
    normal: Array  # (..., 3), geometric


def trace_visible(stage: Stage, view: View, pixels: Array) -> VisibleSurface:
    """The surfaces visible through `pixels` (..., 2), with the stage posed for `view`'s frame."""
    shape = pixels.shape[:-1]
    ray = stage.rays(view, pixels.reshape(-1, 2))
    si = stage.mitsuba_scene.ray_intersect(ray, mi.RayFlags.Minimal, coherent=True)
    mesh_id = stage.mesh_id(si)
    length = dr.select(si.is_valid(), si.t, 0)
    dr.eval(length, si.n, mesh_id)
    depth = depth_along_axis(stage, length, ray, view).astype(np.float64)
    normal = columns(si.n).astype(np.float64)
    return VisibleSurface(depth.reshape(shape), np.array(mesh_id).reshape(shape), normal.reshape(*shape, 3))


def own_surface(stage: Stage, ray: mi.Ray3f) -> tuple[dict[str, dr.AnyArray], mi.Float, mi.Bool]:
    """(channels of what primary rays hit, their length or 0, whether it reflects or transmits perfectly specularly)."""
    si = stage.mitsuba_scene.ray_intersect(ray, mi.RayFlags.All, coherent=True)
    channels = {**surface_channels(stage, Sight.along(ray, si)), "emission": stage.lights.at(si).eval(si)}
    return channels, dr.select(si.is_valid(), si.t, 0), is_in(stage.specular, si.bsdf(), si.is_valid())


def layer_channels(
    stage: Stage, view: View, ray: mi.Ray3f, forms: dict[str, str], max_splits: int
) -> tuple[Arrays, NDArray[np.float32]]:
    """What mirrors and glass show along primary rays, by the names of its channels in `forms`, MIRRORED or SECOND.

    And the probability of reflection at the glass that splits them. See `look_through`.
    """
    shown = look_through(stage, view, ray, forms is SECOND, max_splits)
    depth = depth_along_axis(stage, shown.length, ray, view)
    arrays = {forms[name]: stage.image(value) for name, value in shown.channels.items()}
    arrays[forms["depth"]] = depth.reshape(stage.height, stage.width, 1)
    return arrays, stage.image(shown.reflectance)


def render_gbuffer(stage: Stage, view: View, regularise: bool = False, in_layers: bool = True) -> Arrays:
    """The noise-free channels (H, W, C) of the channel table, with the stage posed for `view`'s frame.

    `regularise` is that of the path tracer whose samples complete them, `in_layers` whether to describe the second
    layer of glass.

    albedo: diffuse reflectance + specular reflectance at normal incidence, in [0, 1]; 1 for background.
    normal: the shading normal in world space, of unit length, toward the viewer; 0 for background.
    roughness: GGX alpha in [0, 1]; 1 for diffuse surfaces and background.
    emission: the radiance of lights and sky, directly visible or by way of perfectly specular surfaces alone.
    depth: along the viewing axis, in world units; 0 for background.
    mesh_id: index of the shape + 1; 0 for background.

    In a scene with mirrors or smooth glass all but emission also in mirrored form: what these show, as if it stood
    behind them; for glass by its more frequent branch. Albedo is multiplied by that of the mirrors, depth follows from
    the length of the whole path. In a scene with glass also of the rarer branch.

    glass_reflectance: the probability of reflection where samples split; 0 without glass.
    """
    ray = stage.rays(view)
    channels, length, shines = stage.replay(own_surface, ray)
    arrays = {name: stage.image(value) for name, value in channels.items()}
    events = stage.max_events(regularise)
    shiny = np.array(shines)
    if shiny.any():
        light = specular_light(stage, ray, events, shiny).reshape(arrays["emission"].shape)
        arrays["emission"] = np.where(stage.image(shines), light, arrays["emission"])
    arrays["depth"] = depth_along_axis(stage, length, ray, view).reshape(stage.height, stage.width, 1)
    if stage.looks_through:
        arrays |= layers(stage, view, ray, arrays, events, shiny.any(), in_layers)
    return arrays


def layers(
    stage: Stage, view: View, ray: mi.Ray3f, own: Arrays, max_splits: int, shines: bool, in_layers: bool
) -> Arrays:
    """What mirrors and glass show along primary rays, if there are any: whether any `shines`.

    `own` are the channels of what the primary rays hit, with which all begins.
    """
    arrays = {MIRRORED[name]: own[name] for name in MIRRORED.keys() & own.keys()}
    reflectance = np.zeros_like(own["depth"])
    if shines or stage.materials.has_mirrors:
        arrays, reflectance = layer_channels(stage, view, ray, MIRRORED, max_splits)
    if stage.glass is None or not in_layers:
        return arrays
    second = {
        SECOND[name]: np.full_like(array, BACKGROUND.get(name, 0)) for name, array in own.items() if name in SECOND
    }
    splits = splits_at(reflectance)
    if splits.any():
        rarer, _ = layer_channels(stage, view, ray, SECOND, max_splits)
        second = {name: np.where(splits, rarer[name], background) for name, background in second.items()}
    return {**arrays, **second, "glass_reflectance": reflectance}


def splits_at(reflectance: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Whether samples take both branches at glass of a reflectance (H, W, 1)."""
    return (reflectance > 0) & (reflectance < 1)


def light_of_second_layer(
    reflectance: NDArray[np.float32], light: Array, reflected: Array, reflections: Array
) -> dict[str, Array]:
    """The channels second_indirect and second_samples (..., H, W, C): the light of samples that take the rarer branch.

    `reflectance` is the channel glass_reflectance, `light` all radiance of the samples, `reflected` that by way of a
    reflection, `reflections` the share of such samples.
    """
    splits = splits_at(reflectance)
    is_reflection = reflectance <= 0.5
    other = (light - reflected).clip(min=0)
    return {
        SECOND["indirect"]: np.where(splits, np.where(is_reflection, reflected, other), 0),
        "second_samples": np.where(splits, np.where(is_reflection, reflections, 1 - reflections), 0),
    }
