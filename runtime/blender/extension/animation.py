"""An animation on disk: rendered frames in one folder, denoised ones in another, and which of these are finished."""

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from .camera import Camera
from .cycles_frame import read_cycles_frame
from .exr import BadFrame, ExrReader, write_exr
from .history import Begin, History

REPLAYED = 32  # frames at most, to restore a history: older ones weigh little
NOTE = "onespp"  # the attribute that says how a denoised frame was made
VERSION = 2  # of the note: frames with another are denoised again


@dataclass
class Animation:
    """Denoises frames in order. A rendered frame is never written to."""

    path_of: Callable[[int], Path]  # of a rendered frame by its number
    folder: Path  # of denoised frames, under the same names
    detects_cuts: bool = True
    keeps_noisy: bool = True
    history: History = field(init=False)

    def __post_init__(self) -> None:
        self.history = History(self.detects_cuts)

    def denoised(self, number: int) -> Path:
        return self.folder / self.path_of(number).name

    def is_rendered(self, number: int) -> bool:
        """Whether there is a frame: Blender's placeholders are empty."""
        path = self.path_of(number)
        return path.is_file() and path.stat().st_size > 0

    def note(self, number: int) -> dict[str, Any] | None:
        """How a finished frame was denoised; None where it has to be, as after it was rendered again."""
        denoised = self.denoised(number)
        if not denoised.exists():
            return None
        try:
            note = json.loads(ExrReader(denoised).attribute(NOTE) or "{}")
        except (BadFrame, json.JSONDecodeError):
            return None
        if (note.get("version"), note.get("detects_cuts")) != (VERSION, self.detects_cuts):
            return None
        is_same = not self.path_of(number).exists() or note["rendered"] == self.stamp(number)
        return note if is_same else None

    def stamp(self, number: int) -> list[int]:
        """Of a rendered frame: another one once it is rendered again."""
        stat = self.path_of(number).stat()
        return [stat.st_size, stat.st_mtime_ns]

    def is_finished(self, number: int) -> bool:
        """Whether nothing has changed that the denoised frame depends on, with the frame before finished, too."""
        note = self.note(number)
        if note is None:
            return False
        if note["begin"] == Begin.GAP and self.is_rendered(number - 1):  # that was not there
            return False
        if note["begin"] == Begin.CONTINUED and self.digest(number - 1) not in (note["before"], None):
            return False
        return self.history.number != number - 1 or note["begin"] in (Begin.CAMERA, Begin.CUT)

    def digest(self, number: int) -> str | None:
        """Of a finished frame's note, and so of all notes before it; None where there is no such frame."""
        note = self.note(number)
        return hashlib.sha256(json.dumps(note).encode()).hexdigest()[:16] if note else None

    def denoise(self, number: int, camera: Camera) -> Begin:
        """Denoise and write a rendered frame. Raises BadFrame where it cannot be, and OSError of the disk."""
        target = self.denoised(number)
        if target.exists() and f"{NOTE}\0string\0".encode() not in target.read_bytes():  # ours may be damaged
            raise BadFrame(f"{target} was not written by this extension: move it away or choose another folder")
        if self.history.number != number - 1:
            self.replay(number)
        stamp = self.stamp(number)
        frame = read_cycles_frame(self.path_of(number))
        radiance, begin = self.history.denoise(number, frame, camera)
        self.folder.mkdir(parents=True, exist_ok=True)
        note = {
            "version": VERSION,
            "detects_cuts": self.detects_cuts,
            "begin": begin,
            "rendered": stamp,
            "before": self.digest(number - 1) if begin == Begin.CONTINUED else None,
            "camera": camera.name,
            "K": camera.K.tolist(),
            "camera_to_world": camera.camera_to_world.tolist(),
        }
        planes = {name: radiance[..., index] for index, name in enumerate("RGB")} | {"A": frame.alpha}
        write_exr(target, planes, {NOTE: json.dumps(note)})
        if not self.keeps_noisy:
            self.path_of(number).unlink()
        return begin

    def replay(self, number: int) -> None:
        """Restore the history before a frame from those finished before it."""
        self.history = History(self.detects_cuts)
        notes: list[tuple[int, dict[str, Any]]] = []
        for before in range(number - 1, number - 1 - REPLAYED, -1):
            note = self.note(before) if self.is_rendered(before) else None
            if note is None:
                break
            notes.append((before, note))
            if note["begin"] != Begin.CONTINUED:
                break
        for before, note in reversed(notes):
            camera = Camera(note["camera"], np.array(note["K"]), np.array(note["camera_to_world"]))
            self.history.denoise(before, read_cycles_frame(self.path_of(before)), camera)
