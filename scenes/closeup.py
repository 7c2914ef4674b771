"""`closeup-N`: a part of `room-N` through a longer lens, as fine as in a picture several times as wide."""

from dataclasses import replace

import numpy as np

from scenes.animation import Camera, Scene, Track
from scenes.rooms import room

LONGEST = 6.0  # times the room's focal length
SHORTEST = 1.5
OFF_CENTRE = 0.6  # of half of the room's picture: how far its part lies from the middle, at most


def aimed_beside(camera: Camera, across: float, up: float, frames: int) -> Track:
    """Targets to the right of and above the camera's, in halves of its picture's width."""
    half_width = np.tan(np.radians(camera.x_fov.at(0)) / 2)
    targets = []
    for frame in range(frames):
        ahead = camera.target.at(frame) - camera.eye.at(frame)
        right = np.cross(ahead, camera.up.at(frame))
        right *= np.linalg.norm(ahead) / np.linalg.norm(right)
        above = np.cross(right, ahead) / np.linalg.norm(ahead)
        targets.append(camera.target.at(frame) + half_width * (across * right + up * above))
    return Track(np.stack(targets), 0, frames - 1)


def closeup(rng: np.random.Generator, frames: int) -> Scene:
    """The room that `rng` draws, and a part of what its camera sees."""
    scene = room(rng, frames)
    longer = np.exp(rng.uniform(np.log(SHORTEST), np.log(LONGEST)))
    across, up = rng.uniform(-OFF_CENTRE, OFF_CENTRE, 2)
    camera = scene.camera
    fov = 2 * np.degrees(np.arctan(np.tan(np.radians(camera.x_fov.at(0)) / 2) / longer))
    target = aimed_beside(camera, across, up, frames)
    return replace(scene, camera=replace(camera, target=target, x_fov=Track.constant(float(fov))))
