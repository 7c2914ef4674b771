"""Presses the extension's button. Runs in a Python that has `bpy`, with BLENDER_USER_RESOURCES as its user's folder.

    python press_button.py render ZIP OUT FRAMES WIDTHxHEIGHT REFERENCE_SPP
    python press_button.py finish OUT/FOLDER [KEEP]

`render` installs ZIP, renders and denoises a room with cuts into OUT/frames and OUT/frames_denoised, and the same
frames with Blender's own OIDN into OUT/oidn. References of the FRAMES first ones are OUT/reference; after these come
two frames of another camera, then two of the same elsewhere. `finish` denoises a folder of these frames; with KEEP `no`
it deletes those. Errors go to stderr.
"""

import math
import sys
from pathlib import Path

import bpy
from render_room import build

BLEND = "room.blend"
REFERENCE_STEP = 3


def add_cuts(frames: int) -> None:
    """A marker that binds another camera, and a jump of the latter."""
    scene = bpy.context.scene
    scene.timeline_markers.new("first", frame=1).camera = scene.camera
    bpy.ops.object.camera_add()
    other = bpy.context.object
    views = (frames + 1, (-1, -5, 2.2), (78, 0, -8)), (frames + 3, (3.5, 2, 1.5), (85, 0, 150))
    for frame, place, turn in views:
        other.location, other.rotation_euler = place, [math.radians(angle) for angle in turn]
        for path in ("location", "rotation_euler"):
            other.keyframe_insert(path, frame=frame)
    for curve in other.animation_data.action.layers[0].strips[0].channelbags[0].fcurves:
        for point in curve.keyframe_points:
            point.interpolation = "CONSTANT"
    scene.timeline_markers.new("other", frame=frames + 1).camera = other
    scene.frame_start, scene.frame_end = 1, frames + 4


def render_again(folder: Path, frames: range, spp: int, denoises: bool) -> None:
    """Without the extension, from what the button has set."""
    scene = bpy.context.scene
    scene.render.filepath = str(folder / "####.exr")
    scene.cycles.samples, scene.cycles.use_denoising = spp, denoises
    scene.cycles.seed = 0 if denoises else 1
    for frame in frames:
        scene.frame_set(frame)
        scene.render.filepath = str(folder / f"{frame:04d}.exr")
        bpy.ops.render.render(write_still=True)


def render(archive: str, out: Path, frames: int, size: str, spp: int) -> None:
    build(frames)  # which also resets what is installed
    bpy.ops.extensions.package_install_files(filepath=archive, repo="user_default", enable_on_install=True)
    add_cuts(frames)
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.render.resolution_x, scene.render.resolution_y = map(int, size.split("x"))
    scene.render.resolution_percentage = 100
    scene.cycles.samples, scene.cycles.use_adaptive_sampling = 1, False
    scene.render.filepath = str(out / "frames" / "####")
    bpy.ops.onespp.denoise_animation()
    bpy.ops.wm.save_as_mainfile(filepath=str(out / BLEND))
    scene.cycles.denoiser = "OPENIMAGEDENOISE"
    render_again(out / "oidn", range(1, frames + 1), 1, denoises=True)
    render_again(out / "reference", range(1, frames + 1, REFERENCE_STEP), spp, denoises=False)


def finish(folder: Path, keeps: str = "yes") -> None:
    bpy.ops.wm.open_mainfile(filepath=str(folder.parent / BLEND))
    bpy.ops.preferences.addon_enable(module="bl_ext.user_default.onespp")
    scene = bpy.context.scene
    scene.render.filepath = str(folder / "####")
    scene.onespp.frames = "FINISHED"
    scene.onespp.keeps_noisy = keeps == "yes"
    bpy.ops.onespp.denoise_animation()


if __name__ == "__main__":
    command, *given = sys.argv[1:]
    if command == "render":
        render(given[0], Path(given[1]), int(given[2]), given[3], int(given[4]))
    else:
        finish(Path(given[0]), *given[1:])
