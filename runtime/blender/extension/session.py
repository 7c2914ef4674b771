"""Denoising while Blender renders: each frame right after it is written."""

import bpy
from bpy.app import handlers

from .animation import Animation
from .camera import Camera
from .exr import BadFrame


class Session:
    """Handlers that denoise the frames of one rendering. They are removed when it ends."""

    running: "Session | None" = None
    error = ""  # of the last session: what stopped denoising, but not rendering

    def __init__(self, scene: bpy.types.Scene, animation: Animation):
        self.scene_name = scene.name
        self.animation = animation
        self.cameras: dict[int, Camera | BadFrame] = {}
        self.events = [
            (handlers.frame_change_post, self.remember_camera),
            (handlers.render_write, self.denoise),
            (handlers.render_complete, self.end),
            (handlers.render_cancel, self.end),
        ]

    def begin(self) -> None:
        if Session.running:
            Session.running.end()
        Session.running, Session.error = self, ""
        for event, handler in self.events:
            event.append(handler)

    def end(self, *_: object) -> None:
        for event, handler in self.events:
            if handler in event:
                event.remove(handler)
        Session.running = None

    def remember_camera(self, scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
        """Rendering evaluates a scene of its own, which the camera of other handlers is not part of."""
        if scene.name == self.scene_name and not scene.frame_subframe:
            try:
                self.cameras[scene.frame_current] = Camera.of(scene, depsgraph)
            except BadFrame as error:
                self.cameras[scene.frame_current] = error

    def denoise(self, scene: bpy.types.Scene, *_: object) -> None:
        if Session.error or scene.name != self.scene_name:
            return
        number = scene.frame_current
        camera = self.cameras.pop(number, None)
        try:
            if not isinstance(camera, Camera):
                raise camera or BadFrame(f"frame {number} has no camera")
            self.animation.denoise(number, camera)
        except (BadFrame, OSError, MemoryError) as error:
            Session.error = str(error)
            print(f"Denoise Animation: {error}")
