"""The panel in the render properties, its options and its operators."""

from collections.abc import Generator
from pathlib import Path

import bpy

from .animation import Animation
from .camera import Camera
from .exr import BadFrame
from .passes import ENGINE, set_passes
from .session import Session


class OnesppOptions(bpy.types.PropertyGroup):
    """Of a scene."""

    frames: bpy.props.EnumProperty(
        name="Frames",
        items=[
            ("RENDER", "Render", "Render the animation and denoise each frame as soon as it is written"),
            ("FINISHED", "Already Rendered", "Denoise the frames that are there, but those that are denoised already"),
        ],
        default="RENDER",
    )
    folder: bpy.props.StringProperty(
        name="Folder",
        description="Of denoised frames. Without, it lies beside that of rendered frames, with _denoised in its name",
        subtype="DIR_PATH",
    )
    detects_cuts: bpy.props.BoolProperty(
        name="Detect Cuts",
        description="Find where another scene begins under the same camera. Markers of cameras always count as cuts",
        default=True,
    )
    keeps_noisy: bpy.props.BoolProperty(
        name="Keep Noisy Frames",
        description="Otherwise each rendered frame is deleted once it is denoised, with all its passes",
        default=True,
    )


def animation_of(scene: bpy.types.Scene) -> Animation:
    """Raises BadFrame where denoised frames would take the place of rendered ones, and without a place for them."""
    options = scene.onespp

    def path_of(number: int) -> Path:
        return Path(scene.render.frame_path(frame=number))

    rendered = path_of(scene.frame_start).parent.resolve()
    if not rendered.name and not options.folder:
        raise BadFrame(f"there is no place beside {rendered}: choose a folder for denoised frames")
    beside = rendered.parent / f"{rendered.name}_denoised"
    folder = Path(bpy.path.abspath(options.folder)).resolve() if options.folder else beside
    if folder == rendered:
        raise BadFrame(f"{folder} is the folder of rendered frames: choose another for denoised ones")
    return Animation(path_of, folder, options.detects_cuts, options.keeps_noisy)


def denoise_finished(context: bpy.types.Context) -> Generator[int, None, None]:
    """Denoise the rendered frames of the scene where necessary; yields the number of each. Raises BadFrame without."""
    scene = context.scene
    animation = animation_of(scene)
    numbers = range(scene.frame_start, scene.frame_end + 1)
    rendered = [number for number in numbers if animation.is_rendered(number)]
    if not rendered and not any(animation.note(number) for number in numbers):
        raise BadFrame(f"there is no frame such as {animation.path_of(scene.frame_start)}: render the animation first")
    now = scene.frame_current
    try:
        for number in rendered:
            if not animation.is_finished(number):
                scene.frame_set(number)
                animation.denoise(number, Camera.of(scene, context.evaluated_depsgraph_get()))
                yield number
    finally:
        scene.frame_set(now)


class ONESPP_OT_set_passes(bpy.types.Operator):  # noqa: N801 - Blender's way
    """Turn on the passes that denoising needs, with multi-layer OpenEXR as output, and Blender's own denoiser off"""

    bl_idname = "onespp.set_passes"
    bl_label = "Set Passes"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            set_passes(context.scene)
        except BadFrame as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return {"FINISHED"}


class ONESPP_OT_denoise_animation(bpy.types.Operator):  # noqa: N801
    """Denoise all frames of the animation, while they are rendered or afterwards. Rendered frames stay as they are"""

    bl_idname = "onespp.denoise_animation"
    bl_label = "Denoise Animation"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Without a window: returns when all is done."""
        try:
            if context.scene.onespp.frames == "FINISHED":
                for _ in denoise_finished(context):
                    pass
            else:
                self.render(context, "EXEC_DEFAULT")
                if Session.error:
                    raise BadFrame(Session.error)
        except (ValueError, OSError, MemoryError, RuntimeError) as error:
            return self.failed(error)
        return {"FINISHED"}

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """In a window, which stays alive. Escape stops."""
        try:
            if context.scene.onespp.frames == "RENDER":
                self.render(context, "INVOKE_DEFAULT")
                return {"FINISHED"}
        except (ValueError, OSError, RuntimeError) as error:
            return self.failed(error)
        self.finished = denoise_finished(context)
        manager = context.window_manager
        self.timer = manager.event_timer_add(0.01, window=context.window)
        manager.progress_begin(context.scene.frame_start, context.scene.frame_end + 1)
        manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if event.type == "ESC":
            return self.stop(context, {"CANCELLED"})
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        try:
            context.window_manager.progress_update(next(self.finished))
        except StopIteration:
            return self.stop(context, {"FINISHED"})
        except (ValueError, OSError, MemoryError) as error:
            self.stop(context, {"CANCELLED"})
            return self.failed(error)
        return {"RUNNING_MODAL"}

    def stop(self, context: bpy.types.Context, result: set[str]) -> set[str]:
        self.finished.close()
        context.window_manager.event_timer_remove(self.timer)
        context.window_manager.progress_end()
        return result

    def failed(self, error: Exception) -> set[str]:
        self.report({"ERROR"}, str(error))
        return {"CANCELLED"}

    def render(self, context: bpy.types.Context, call: str) -> None:
        set_passes(context.scene)
        animation = animation_of(context.scene)
        animation.folder.mkdir(parents=True, exist_ok=True)  # or fail before the first frame is rendered
        session = Session(context.scene, animation)
        session.begin()
        try:
            bpy.ops.render.render(call, animation=True)
        except RuntimeError:  # which no handler is told of
            session.end()
            raise


class ONESPP_PT_denoise(bpy.types.Panel):  # noqa: N801
    """One button and its options."""

    bl_label = "Denoise Animation"
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "render"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return context.scene.render.engine == ENGINE

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.operator(ONESPP_OT_denoise_animation.bl_idname, icon="RENDER_ANIMATION")
        for name in ("frames", "folder", "detects_cuts", "keeps_noisy"):
            layout.prop(context.scene.onespp, name)
        if Session.error:
            layout.label(text=Session.error, icon="ERROR")


CLASSES = (OnesppOptions, ONESPP_OT_set_passes, ONESPP_OT_denoise_animation, ONESPP_PT_denoise)


def register() -> None:
    for each in CLASSES:
        bpy.utils.register_class(each)
    bpy.types.Scene.onespp = bpy.props.PointerProperty(type=OnesppOptions)


def unregister() -> None:
    if Session.running:
        Session.running.end()
    del bpy.types.Scene.onespp
    for each in reversed(CLASSES):
        bpy.utils.unregister_class(each)
