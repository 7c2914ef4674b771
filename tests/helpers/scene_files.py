"""Small scene files of other programs, written by tests."""

from pathlib import Path

import pytest

from errors import BadInput
from render.scene_file.load import OwnScene

LOOK = '<transform name="{}"><lookat origin="0,0,5" target="0,0,0" up="0,1,0"/></transform>'
CAMERA = f'<sensor type="perspective"><float name="fov" value="40"/>{LOOK.format("to_world")}</sensor>'
OLD_CAMERA = f'<sensor type="perspective"><float name="fov" value="40"/>{LOOK.format("toWorld")}</sensor>'
SKY = '<emitter type="constant"/>'
BALL = '<shape type="sphere" id="ball"/>'


def xml(*parts: str, camera: str = CAMERA, light: str = SKY, shape: str = BALL) -> str:
    """A scene of today's Mitsuba: a ball before a camera under a white sky, and the `parts`."""
    return f'<scene version="3.0.0">{camera}{light}{shape}{"".join(parts)}</scene>'


def old_xml(*parts: str, light: str = SKY, shape: str = BALL) -> str:
    """The same of Mitsuba 0.6, whose properties have other names."""
    return f'<scene version="0.6.0">{OLD_CAMERA}{light}{shape}{"".join(parts)}</scene>'


def painted(bsdf: str) -> str:
    """A ball of a material."""
    return f'<shape type="sphere" id="ball">{bsdf}</shape>'


def write(folder: Path, content: str | bytes, toml: str = "", name: str = "scene.xml") -> Path:
    """Write a scene file and the TOML that names it; the TOML's path."""
    (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    path = folder / "my.toml"
    path.write_text(f'file = "{name}"\nresolution = [32, 24]\nframes = 2\n{toml}')
    return path


def own(folder: Path, content: str | bytes, toml: str = "", name: str = "scene.xml") -> OwnScene:
    """The scene in a file with that content."""
    return OwnScene(write(folder, content, toml, name))


def refusal(folder: Path, content: str | bytes, toml: str = "", name: str = "scene.xml") -> str:
    """The one line that refuses a file with that content."""
    with pytest.raises(BadInput) as error:
        own(folder, content, toml, name)
    text = str(error.value)
    assert "\n" not in text and ".cpp" not in text and "Traceback" not in text and len(text) < 600
    return text
