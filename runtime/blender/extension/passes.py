"""What a scene must render for its frames to be denoised."""

import bpy

from .exr import BadFrame

ENGINE = "CYCLES"


def check(scene: bpy.types.Scene) -> None:
    """Raise BadFrame where rendering the scene would give frames that cannot be denoised."""
    if scene.render.engine != ENGINE:
        raise BadFrame(f"the render engine is {scene.render.engine}: choose Cycles")
    if scene.camera is None:
        raise BadFrame("the scene has no camera: add one")
    if scene.render.use_motion_blur:
        raise BadFrame("motion blur leaves no Vector pass: turn it off, and blur the denoised frames instead")
    if scene.frame_step != 1:
        raise BadFrame(f"the frame step is {scene.frame_step}, but motion vectors lead one frame back: set it to 1")
    if scene.render.use_multiview:
        raise BadFrame("stereoscopy cannot be denoised: render one view at a time")
    used = [layer.name for layer in scene.view_layers if layer.use]
    if len(used) != 1:
        raise BadFrame(f"{len(used)} view layers are used for rendering ({', '.join(used)}): use one")


def set_passes(scene: bpy.types.Scene) -> None:
    """Turn on the passes and their output, and what would spoil them off. Raises BadFrame as `check`."""
    check(scene)
    layer = next(layer for layer in scene.view_layers if layer.use)
    layer.use_pass_combined = layer.use_pass_z = layer.use_pass_vector = True
    layer.use_pass_normal = layer.use_pass_emit = True
    layer.cycles.denoising_store_passes = True
    scene.cycles.use_denoising = False  # a second one takes time, and nobody sees its result
    scene.cycles.use_animated_seed = True  # noise that stays the same would be taken for texture
    output = scene.render.image_settings
    if hasattr(output, "media_type"):  # since Blender 5.0
        output.media_type = "MULTI_LAYER_IMAGE"
    output.file_format = "OPEN_EXR_MULTILAYER"
    output.color_depth = "32"  # half precision is too coarse for depth and motion
    output.exr_codec = "ZIP"
