"""A user's own scene: the file that a TOML names, its camera, motion and lights, as a Scene like the built-in ones."""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from errors import BadInput
from render.backend import mi
from render.scene_file.camera import camera_of_sensor, camera_that_sees
from render.scene_file.convert import convert
from render.scene_file.flight import Space, fly
from render.stage import Stage
from scenes.animation import Camera, KeyframedTrack, Scene, Shape
from scenes.camera import Array, look_at
from scenes.description import camera_of, gain_of, motion_of, read_description
from scenes.mesh_file import load_mesh_file

DEFAULT_DEPTH = 3  # path edges, where neither file says: one indirect bounce
WITHOUT_CAMERA = camera_that_sees(np.zeros(3), np.ones(3))  # until the size of the scene is known
MOST_SHAPES = 65535  # mesh ids are 16 bits
MOST_DEPTH = 64  # where the file asks for endless paths; Russian roulette ends them before


class OwnScene:
    """What a TOML describes, as it stands in its file.

    `notes` say what is not honoured, and what stands in for it. Raises BadInput, naming the file, for what cannot be
    used.
    """

    def __init__(self, path: Path):
        self.path = path
        self.described = read_description(path)
        self.width, self.height = self.described.resolution
        self.file = path.resolve().parent / self.described.file
        self.has_camera = True
        scene, self.notes = self.from_xml() if self.file.suffix.lower() == ".xml" else self.from_meshes()
        depth = scene.max_depth if self.described.bounces is None else self.described.bounces + 1
        self.scene = replace(scene, max_depth=depth)
        self.check_names()
        if len(self.scene.meshes) > MOST_SHAPES:
            raise BadInput(f"{self.file} has {len(self.scene.meshes)} shapes: at most {MOST_SHAPES} can be told apart")
        try:
            self.stage = Stage(self.scene, self.height, self.width)  # at rest, to fly through
        except BadInput as error:
            raise BadInput(f"{self.file}: {error}") from None
        self.notes += self.stage.notes
        if not self.has_camera:
            self.notes.append("there is no camera: one that sees the whole scene instead")
            space = Space(self.stage)
            self.scene = replace(self.scene, camera=camera_that_sees(space.low, space.high))

    def from_xml(self) -> tuple[Scene, list[str]]:
        """The scene of a Mitsuba file, whose camera stands still, and what is not honoured."""
        found = convert(self.file)
        camera, notes = WITHOUT_CAMERA, [*found.notes]
        self.has_camera = found.sensor is not None
        if found.sensor:
            try:
                camera, more = camera_of_sensor(found.sensor, self.height, self.width)
            except BadInput as error:
                raise BadInput(f"{self.file}: {error}") from None
            notes += more
        depth = min(found.max_depth or DEFAULT_DEPTH, MOST_DEPTH)
        return Scene((), camera, depth, stock=tuple(found.shapes), lights=tuple(found.lights)), notes

    def from_meshes(self) -> tuple[Scene, list[str]]:
        """The scene of a glTF, OBJ or PLY file, and what is not honoured."""
        found = load_mesh_file(self.file, self.width / self.height)
        self.has_camera = found.camera is not None
        scene = Scene(tuple(found.shapes), found.camera or WITHOUT_CAMERA, DEFAULT_DEPTH, sky=found.sky)
        return scene, found.notes

    def check_names(self) -> None:
        """Raise BadInput for motion of a shape, or change of a light, that is not in the file."""
        shapes = {shape.name for shape in self.scene.meshes}
        lights = {light.name for light in self.scene.lights}
        lights |= {shape.name for shape in self.scene.stock if shape.emitter}
        lights |= {shape.name for shape in self.scene.shapes if shape.radiance}
        for name in (each.shape for each in self.described.motion):
            if name not in shapes:
                raise BadInput(f"{self.path}: there is no shape '{name}'; {known(shapes)}")
        for name in (each.light for each in self.described.light):
            if name not in lights:
                raise BadInput(f"{self.path}: there is no light '{name}'; {known(lights)}")

    def clip(self, frames: int, seed: int, by_keyframes: bool, from_here: bool) -> Scene:
        """The scene of a clip: flown by the keyframes of the TOML, or through free space from the file's camera.

        Where not `from_here`, the flight begins at another place that can be reached from there.
        """
        if by_keyframes:
            camera = camera_of(self.described.camera, self.scene.camera, frames)
            check_camera(camera, frames, self.path)
        else:
            camera = fly(self.stage, self.scene.camera, frames, seed, from_here)
        return replace(self.animated(frames), camera=camera)

    def animated(self, frames: int) -> Scene:
        """The scene with the motion and the changing lights of the TOML."""
        scene = self.scene
        by_name = {shape.name: loaded for shape, loaded in zip(scene.meshes, self.stage.shapes, strict=True)}
        motions = {
            each.shape: motion_of(each.keyframes, centre_of(by_name[each.shape]) * self.stage.unit, frames)
            for each in self.described.motion
        }
        gains = {each.light: gain_of(each.keyframes, frames) for each in self.described.light}
        shapes = [replace(shape, motion=motions.get(shape.name, shape.motion)) for shape in scene.shapes]
        stock = [replace(shape, motion=motions.get(shape.name, shape.motion)) for shape in scene.stock]
        return replace(
            scene,
            shapes=tuple(brightened(shape, gains.get(shape.name)) for shape in shapes),
            stock=tuple(replace(shape, gain=gains.get(shape.name, shape.gain)) for shape in stock),
            lights=tuple(replace(light, gain=gains.get(light.name, light.gain)) for light in scene.lights),
        )


def check_camera(camera: Camera, frames: int, path: Path) -> None:
    """Raise BadInput, naming the TOML, where a camera that flies by keyframes cannot see."""
    for frame in range(frames):
        pose = look_at(camera.eye.at(frame), camera.target.at(frame), camera.up.at(frame))
        if not np.isfinite(pose).all() or not 0 < camera.x_fov.at(frame) < 180:
            raise BadInput(
                f"{path}: in frame {frame} the camera is where it looks, looks along its up, or sees 180 degrees or "
                "more: change its keyframes"
            )


def brightened(shape: Shape, gain: KeyframedTrack | None) -> Shape:
    """The shape with what it emits times `gain` over time."""
    if gain is None or shape.radiance is None:
        return shape
    return replace(shape, radiance=replace(gain, keys=np.outer(gain.keys, shape.radiance.at(0))))


def centre_of(shape: mi.Shape) -> Array:
    """The middle (3,) of a shape's box, in Mitsuba's units: about it the shape turns."""
    box = shape.bbox()
    return (np.array(box.min, np.float64) + np.array(box.max, np.float64)).ravel() / 2


def known(names: set[str]) -> str:
    """The names there are, for messages."""
    shown = sorted(names)
    more = f" and {len(shown) - 20} more" if len(shown) > 20 else ""
    return f"there are {', '.join(shown[:20])}{more}" if shown else "there are none"


@lru_cache(maxsize=1)
def own_scene(path: Path) -> OwnScene:
    """The scene that a TOML describes, read once for all of its clips."""
    return OwnScene(path)
