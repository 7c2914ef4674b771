"""Renders a room of Blender's own primitives with Cycles. Runs in a Python that has `bpy`, which needs another numpy.

    python render_room.py OUT FRAMES WIDTHxHEIGHT REFERENCE_SPP

OUT/noisy/0001.exr and so on have 1 sample per pixel, all passes that a denoiser wants, and as `Combined` what Blender's
own OIDN makes of it; OUT/reference/0001.exr and so on are not denoised.
"""

import math
import sys
from pathlib import Path

import bpy


def textured(name: str, scale: float, roughness: float, colour: tuple[float, float, float]) -> bpy.types.Material:
    """A checkered principled material."""
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    checker = nodes.new("ShaderNodeTexChecker")
    checker.inputs["Scale"].default_value = scale
    checker.inputs["Color1"].default_value = (*colour, 1)
    checker.inputs["Color2"].default_value = (*(0.3 * c for c in colour), 1)
    shader = nodes["Principled BSDF"]
    shader.inputs["Roughness"].default_value = roughness
    links.new(checker.outputs["Color"], shader.inputs["Base Color"])
    return material


def build(frames: int) -> None:
    """Floor, walls, a lamp, four objects of which one moves, and a camera that flies."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    wall = textured("wall", 6, 0.9, (0.7, 0.65, 0.6))
    planes = [((0, 0, 0), (0, 0, 0)), ((0, 4, 4), (math.pi / 2, 0, 0)), ((-4, 0, 4), (0, math.pi / 2, 0))]
    for place, turn in planes:
        bpy.ops.mesh.primitive_plane_add(size=8, location=place, rotation=turn)
        bpy.context.object.data.materials.append(wall)
    bpy.ops.object.light_add(type="AREA", location=(1, -1, 5))
    bpy.context.object.data.energy, bpy.context.object.data.size = 300, 1.5
    things = [
        ("primitive_cube_add", {"size": 1.2, "location": (-1.2, 1, 0.6)}, textured("cube", 4, 0.6, (0.8, 0.2, 0.1))),
        (
            "primitive_uv_sphere_add",
            {"radius": 0.8, "location": (0.8, 0.5, 0.8)},
            textured("ball", 9, 0.3, (0.1, 0.5, 0.8)),
        ),
        ("primitive_torus_add", {"location": (0, -1.2, 0.3)}, textured("ring", 8, 0.5, (0.2, 0.7, 0.3))),
        ("primitive_cone_add", {"radius1": 0.6, "location": (2, 2, 1)}, textured("cone", 5, 0.8, (0.8, 0.7, 0.2))),
    ]
    for operator, arguments, material in things:
        getattr(bpy.ops.mesh, operator)(**arguments)
        bpy.context.object.data.materials.append(material)
    moving = bpy.context.object
    for frame, x in ((1, 2.0), (frames, 1.2)):
        moving.location.x = x
        moving.keyframe_insert("location", frame=frame)
    bpy.ops.object.camera_add()
    camera = bpy.context.object
    for frame, x in ((1, 4.5), (frames, 5.1)):
        camera.location = (x, -5.5, 3.2)
        camera.rotation_euler = (math.radians(68), 0, math.radians(40 + 4 * (x - 4.5)))
        camera.keyframe_insert("location", frame=frame)
        camera.keyframe_insert("rotation_euler", frame=frame)
    bpy.context.scene.camera = camera


def render(folder: Path, frames: int, spp: int, noisy: bool) -> None:
    """Render all frames as multi-layer EXR."""
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.samples = spp
    scene.cycles.use_adaptive_sampling = False
    scene.cycles.use_denoising = noisy
    scene.cycles.denoiser = "OPENIMAGEDENOISE"
    scene.cycles.seed = 0 if noisy else 1
    scene.cycles.use_animated_seed = True
    layer = bpy.context.view_layer
    layer.use_pass_z = layer.use_pass_vector = layer.use_pass_normal = noisy
    layer.cycles.denoising_store_passes = noisy
    settings = scene.render.image_settings
    if hasattr(settings, "media_type"):
        settings.media_type = "MULTI_LAYER_IMAGE"
    settings.file_format = "OPEN_EXR_MULTILAYER"
    settings.color_depth = "32"
    for frame in range(1, frames + 1):
        scene.frame_set(frame)
        scene.render.filepath = str(folder / f"{frame:04d}.exr")
        bpy.ops.render.render(write_still=True)


def main() -> None:
    out, frames, size, spp = Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3].split("x"), int(sys.argv[4])
    build(frames)
    scene = bpy.context.scene
    scene.render.resolution_x, scene.render.resolution_y = map(int, size)
    scene.render.resolution_percentage = 100
    render(out / "noisy", frames, 1, noisy=True)
    render(out / "reference", frames, spp, noisy=False)


if __name__ == "__main__":
    main()
