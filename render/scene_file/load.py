"""A user's own scene: the file that a TOML names, with its camera, motion and lights, as a Scene."""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from errors import BadInput
from render.backend import mi
from render.loading import columns, corners, mitsuba_reason
from render.path import PathTracer
from render.scene_file.convert import UP, SceneFile
from render.scene_file.description import camera_of, gain_of, motion_of, read_description
from render.scene_file.flight import Space, fly, upright
from render.scene_file.mesh_file import MeshFile
from render.specular_light import specular_light
from render.stage import MAX_EVENTS, Stage
from scenes.animation import Camera, KeyframedTrack, Scene, Shape
from scenes.camera import Array, look_at, pixel_centres, up_of

DEFAULT_DEPTH = 3  # path edges: one indirect bounce
MAX_DEPTH = 64  # that files get; Russian roulette ends most paths before
MAX_SHAPES = 65535  # mesh ids have 16 bits
FOV_WITHOUT_CAMERA = 50.0  # degrees


def camera_of_sensor(sensor: dict[str, Any], height: int, width: int) -> tuple[Camera, list[str]]:
    """The static camera of a perspective sensor's dictionary, for images of this size, and notes on omissions.

    Its field of view holds for the axis that the sensor names. Raises BadInput if the sensor is invalid.
    """
    film = {"type": "hdrfilm", "width": width, "height": height}
    lens = {key: value for key, value in sensor.items() if key in ("fov", "fov_axis", "focal_length")}
    try:
        loaded = mi.load_dict({"type": "perspective", "film": film, **lens})
    except RuntimeError as error:
        raise BadInput(f"the camera cannot be used: {mitsuba_reason(error)}") from None
    x_fov = float(np.array(mi.traverse(loaded)["x_fov"]).ravel()[0])
    to_world = np.asarray(sensor.get("to_world", np.eye(4)), np.float64)
    if not np.isfinite(to_world).all() or np.linalg.det(to_world[:3, :3]) == 0:
        raise BadInput(f"the camera cannot be used: its to_world is {to_world.tolist()}")
    axes = to_world[:3, :3] / np.linalg.norm(to_world[:3, :3], axis=0)
    eye = to_world[:3, 3]
    notes = []
    if np.linalg.det(axes) < 0:
        notes.append("the camera mirrors its image: not mirrored instead")
    if any(sensor.get(f"principal_point_offset_{axis}", 0) != 0 for axis in "xy"):
        notes.append("the camera's principal point is off centre: in the centre instead")
    return Camera.at_rest(eye, eye + axes[:, 2], x_fov, up_of(axes, np.array(sensor.get(UP, axes[:, 1])))), notes


def camera_framing(low: Array, high: Array) -> Camera:
    """A static camera slightly above the box from `low` (3,) to `high` (3,), with all of it in view."""
    centre = (low + high) / 2
    away = np.array([0.3, 0.25, 1.0])
    distance = max(float(np.linalg.norm(high - low)) / 2, 1e-6) / np.sin(np.radians(FOV_WITHOUT_CAMERA) / 2)
    return Camera.at_rest(centre + away / np.linalg.norm(away) * distance, centre, FOV_WITHOUT_CAMERA)


DEFAULT_CAMERA = camera_framing(np.zeros(3), np.ones(3))  # until the extent of the scene is known

PROBED_PIXELS = 2000
PROBE_SPP = 32
PROBED_DEPTHS = (5, 9, 17)
TRACED = "% of the light"  # in notes that depend on random paths


def note_on_depth(stage: Stage, scene: Scene) -> list[str]:
    """Whether most light needs longer paths than the scene's: that of lamps in glass, or behind it."""
    if not stage.materials.transmits:
        return []
    count = stage.height * stage.width
    pixel = np.arange(0, count, max(1, count // PROBED_PIXELS))
    centres = pixel_centres(stage.height, stage.width).reshape(-1, 2)
    rays = stage.rays(scene.view(0, stage.height, stage.width), centres[pixel])
    shows_no_lamp = ~specular_light(stage, rays, MAX_EVENTS).any(axis=1)
    tracer = PathTracer(stage)

    def light(depth: int) -> float:
        """Mean radiance of surfaces, each pixel's at most 1: fireflies would hide how much most of them get."""
        stage.scene = replace(scene, max_depth=depth)
        direct, indirect, *_ = tracer.samples(rays, mi.UInt32(pixel.astype(np.uint32)), 0, PROBE_SPP)
        return float(np.minimum(columns(direct + indirect), 1).mean(axis=1) @ shows_no_lamp)

    own = light(scene.max_depth)
    lights = {depth: light(depth) for depth in PROBED_DEPTHS if depth > scene.max_depth}
    stage.scene = scene
    if not lights or own >= 0.5 * max(lights.values()):
        return []
    enough = next(depth for depth, value in lights.items() if value >= 0.9 * max(lights.values()))
    share = 100 * own / max(lights.values())
    most = PROBED_DEPTHS[-1] - 1
    few = f"with {scene.max_depth - 1} bounces only {share:.0f} {TRACED} of {most} bounces arrives"
    return [f"{few}, perhaps because lamps shine through glass: set `bounces = {enough - 1}` in the TOML"]


class OwnScene:
    """The scene that a TOML describes, at rest.

    `notes` list what is not honoured, and its stand-ins, `files` all that it is read from. Raises BadInput, naming the
    file, if it cannot be used.
    """

    def __init__(self, path: Path):
        self.path = path
        self.described = read_description(path)
        self.width, self.height = self.described.resolution
        self.file = path.resolve().parent / self.described.file
        scene, self.notes = self.from_xml() if self.file.suffix.lower() == ".xml" else self.from_meshes()
        depth = scene.max_depth if self.described.bounces is None else self.described.bounces + 1
        self.scene = replace(scene, max_depth=depth)
        self.check_names()
        if len(self.scene.meshes) > MAX_SHAPES:
            raise BadInput(f"{self.file} has {len(self.scene.meshes)} shapes, the limit is {MAX_SHAPES}: merge some")
        try:
            self.stage = Stage(self.scene, self.height, self.width)  # at rest, to fly through
        except BadInput as error:
            raise BadInput(f"{self.file}: {error}") from None
        self.notes += self.stage.notes
        if scene.camera is DEFAULT_CAMERA:
            self.notes.append("there is no camera: one that frames the whole scene instead")
            space = Space(self.stage)
            self.scene = replace(self.scene, camera=camera_framing(space.low, space.high))
        self.notes += note_on_depth(self.stage, self.scene)
        folder = f"{self.file.resolve().parent}/"
        self.notes = [note.replace(folder, "") for note in self.notes]  # the same wherever the scene is

    def from_xml(self) -> tuple[Scene, list[str]]:
        found = SceneFile(self.file)
        self.files = found.files
        camera, notes = DEFAULT_CAMERA, [*found.notes]
        if found.sensor:
            try:
                camera, more = camera_of_sensor(found.sensor, self.height, self.width)
            except BadInput as error:
                raise BadInput(f"{self.file}: {error}") from None
            notes += more
        depth = min(found.max_depth or DEFAULT_DEPTH, MAX_DEPTH)
        return Scene((), camera, depth, stock=tuple(found.shapes), lights=tuple(found.lights)), notes

    def from_meshes(self) -> tuple[Scene, list[str]]:
        found = MeshFile(self.file, self.width / self.height)
        self.files = found.files
        return Scene(tuple(found.shapes), found.camera or DEFAULT_CAMERA, DEFAULT_DEPTH, sky=found.sky), found.notes

    def check_names(self) -> None:
        """Raise BadInput for keyframes of a shape or light that is not in the file."""
        shapes = {shape.name for shape in self.scene.meshes}
        lights = {light.name for light in self.scene.lights}
        lights |= {shape.name for shape in self.scene.stock if shape.emitter}
        lights |= {shape.name for shape in self.scene.shapes if shape.radiance}
        wanted = [("shape", motion.shape, shapes) for motion in self.described.motion]
        wanted += [("light", change.light, lights) for change in self.described.light]
        for kind, name, names in wanted:
            if name not in names:
                more = f" and {len(names) - 20} more" if len(names) > 20 else ""
                listed = f"there are {', '.join(sorted(names)[:20])}{more}" if names else "there are none"
                raise BadInput(f"{self.path}: there is no {kind} '{name}'; {listed}")

    def clip(self, split: str, number: int, frames: int, seed: int) -> Scene:
        """The scene of a clip, with a camera by the keyframes of the TOML, or a flight as flight.fly describes.

        The first test clip begins with the file's camera. Raises BadInput, naming the TOML, if keyframes give no valid
        view of a frame.
        """
        chosen = getattr(self.described.splits, split).camera
        if chosen == "keyframes" or (chosen is None and self.described.camera):
            camera = camera_of(self.described.camera, upright(self.scene.camera), frames)
            for frame in range(frames):
                pose = look_at(camera.eye.at(frame), camera.target.at(frame), camera.up.at(frame))
                if not np.isfinite(pose).all() or not 0 < camera.x_fov.at(frame) < 180:
                    faults = "position equals its target, its up is its viewing axis, or its fov is 180 degrees or more"
                    raise BadInput(f"{self.path}: in frame {frame} the camera's {faults}: change its keyframes")
        else:
            camera = fly(self.stage, self.scene.camera, frames, seed, from_here=(split, number) == ("test", 0))
        scene = self.scene
        boxes = {shape.id(): corners(shape.bbox()) * self.stage.unit for shape in self.stage.shapes}
        motions = {
            motion.shape: motion_of(motion.keyframes, boxes[motion.shape].mean(axis=0), frames)
            for motion in self.described.motion
        }
        gains = {change.light: gain_of(change.keyframes, frames) for change in self.described.light}
        shapes = [replace(shape, motion=motions.get(shape.name, shape.motion)) for shape in scene.shapes]
        stock = [replace(shape, motion=motions.get(shape.name, shape.motion)) for shape in scene.stock]
        return replace(
            scene,
            camera=camera,
            shapes=tuple(brightened(shape, gains.get(shape.name)) for shape in shapes),
            stock=tuple(replace(shape, gain=gains.get(shape.name, shape.gain)) for shape in stock),
            lights=tuple(replace(light, gain=gains.get(light.name, light.gain)) for light in scene.lights),
        )


def brightened(shape: Shape, gain: KeyframedTrack | None) -> Shape:
    if gain is None or shape.radiance is None:
        return shape
    return replace(shape, radiance=replace(gain, keys=np.outer(gain.keys, shape.radiance.at(0))))


own_scene = lru_cache(maxsize=1)(OwnScene)  # read once for all of its clips
