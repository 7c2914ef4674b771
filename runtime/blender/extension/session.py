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
        self.camera: Camera | BadFrame | None = None  # of the frame that is being rendered
        self.events = [
            (handlers.render_pre, self.forget_camera),
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

    def forget_camera(self, scene: bpy.types.Scene, *_: object) -> None:
        if scene.name == self.scene_name:
            self.camera = None

    def remember_camera(self, scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
        """Of the first scene that is evaluated for a frame: others are its neighbours, for motion vectors.

        Where one of those is beyond a marker, the scene keeps that marker's camera to the end of the frame.
        """
        if scene.name == self.scene_name and self.camera is None:
            try:
                self.camera = Camera.of(scene, depsgraph)
            except BadFrame as error:
                self.camera = error

    def denoise(self, scene: bpy.types.Scene, *_: object) -> None:
        if Session.error or scene.name != self.scene_name:
            return
        number, camera = scene.frame_current, self.camera
        try:
            if not isinstance(camera, Camera):
                raise camera or BadFrame(f"frame {number} has no camera")
            self.animation.denoise(number, camera)
        except (ValueError, OSError, MemoryError) as error:  # BadFrame, and what the runtime refuses
            Session.error = str(error)
            print(f"Denoise Animation: {error}")
