"""Changes of a loaded scene from frame to frame, as values of Mitsuba's parameters."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from errors import BadInput
from render.backend import dr, mi
from render.loading import upload
from scenes.animation import FreeMotion, RigidMotion, Shape, StockLight, StockShape
from scenes.camera import Array

Changes = dict[str, NDArray[np.float32]]  # by the parameter's name

PLACEMENT = ("to_world", "vertex_positions", "vertex_normals")
BRIGHTNESS = ("radiance.value", "radiance.data", "intensity.value", "irradiance.value", "irradiance.data")
SCALES = {"envmap": ("scale",), "projector": ("scale",), "sunsky": ("sun_scale", "sky_scale")}  # instead of BRIGHTNESS
POINT_LIGHTS = ("point", "spot", "projector")


def mesh_changes(shape: Shape, frame: float, unit: float, moves: bool) -> Changes:
    """A mesh's vertices, if it `moves`, and the light that it emits."""
    changes: Changes = {}
    if moves:
        matrix = shape.motion.matrix(frame)
        vertices = (shape.mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3]) / unit
        changes[f"{shape.name}.vertex_positions"] = np.float32(vertices).ravel()
        if shape.smooth:
            changes[f"{shape.name}.vertex_normals"] = np.float32(shape.mesh.vertex_normals @ matrix[:3, :3].T).ravel()
    if shape.radiance is not None:
        changes[f"{shape.name}.emitter.radiance.value"] = shape.radiance.at(frame).astype(np.float32)
    return changes


def is_placed(motion: RigidMotion | FreeMotion) -> bool:
    """Whether it ever takes a shape from its rest pose."""
    return motion.varies() or bool((motion.matrix(0) != np.eye(4)).any())


class StockParameters:
    """The parameters at rest of a stock shape or light that moves or changes. Raises BadInput if it cannot."""

    def __init__(self, described: StockShape | StockLight, parameters: mi.SceneParameters, unit: float):
        self.described = described
        self.unit = unit
        name = described.name
        self.rest: dict[str, Array] = {}
        if isinstance(described, StockShape) and is_placed(described.motion):
            self.rest = at_rest(parameters, [f"{name}.{key}" for key in PLACEMENT])
            if not self.rest:
                raise BadInput(f"shape '{name}' cannot move: it is of the kind {described.geometry['type']}")
        self.light: dict[str, Array] = {}
        kind = described.emitter["type"] if described.emitter else "none"
        # Irradiance of point lights falls with the square of the distance, which is in Mitsuba's units.
        self.factor = unit**-2 if kind in POINT_LIGHTS else 1.0
        if described.gain.varies() or described.gain.at(0) != 1 or self.factor != 1:
            prefix = f"{name}.emitter" if isinstance(described, StockShape) else name
            self.light = at_rest(parameters, [f"{prefix}.{key}" for key in SCALES.get(kind, BRIGHTNESS)])
            if not self.light:
                raise BadInput(f"the light of '{name}' cannot change: it is of the kind {kind}")

    def changes(self, frame: float) -> Changes:
        values = {name: value * (self.factor * self.described.gain.at(frame)) for name, value in self.light.items()}
        if self.rest and isinstance(self.described, StockShape):
            matrix = self.described.motion.matrix(frame)
            matrix[:3, 3] /= self.unit
            values |= {name: moved(name, value, matrix) for name, value in self.rest.items()}
        return {name: value.astype(np.float32) for name, value in values.items()}


def at_rest(parameters: mi.SceneParameters, names: list[str]) -> dict[str, Array]:
    """The values of the named parameters that exist and are not empty."""
    values: dict[str, Array] = {}
    for name in names:
        if name in parameters:
            value = parameters[name]
            values[name] = np.array(value.matrix if isinstance(value, mi.AffineTransform4f) else value, np.float64)
    return {name: value for name, value in values.items() if value.size}


def moved(name: str, value: Array, matrix: Array) -> Array:
    """to_world (4, 4), vertices (3 N,) or normals (3 N,) of a shape transformed by `matrix` (4, 4)."""
    if name.endswith("to_world"):
        return matrix @ value.reshape(4, 4)
    shift = matrix[:3, 3] if name.endswith("positions") else 0
    return (value.reshape(-1, 3) @ matrix[:3, :3].T + shift).ravel()


def as_parameter(value: NDArray[np.float32], parameter: Any) -> Any:
    """A value as data for kernels, of the type of `parameter`."""
    if isinstance(parameter, float):
        return float(value)
    if isinstance(parameter, mi.TensorXf):
        return mi.TensorXf(upload(value.ravel()), value.shape)
    if value.shape == (4, 4):
        matrix = mi.AffineTransform4f(value)
        dr.make_opaque(matrix)
        return matrix
    if value.shape in ((3,), (3, 1)) and isinstance(parameter, mi.Color3f):
        return mi.Color3f(*map(upload, value.reshape(3, 1)))
    return upload(value.ravel())
