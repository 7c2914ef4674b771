"""The options of `onespp denoise`: their types, defaults and descriptions, which `--help` prints."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import FlagCreatePairsOff, Positional, arg

from denoise.layers import COLOUR
from errors import BadInput

Patterns = Annotated[tuple[str, ...], arg(metavar="PATTERN...")]  # such as 'frames/*.exr', or files
Flag = Annotated[bool, FlagCreatePairsOff]


@dataclass(frozen=True)
class Job:
    """A sequence to denoise.

    Attributes:
        frames: files with the colour, usually with all layers
        denoiser: NETWORK@BUDGET for weights in RUNS
        out: output folder; frames keep their names
        weights: by default the shipped ones
        hdr: another name for the colour's files
        half: sample buffer B of the same frames, for NAME+js
        alb: albedo in separate files
        nrm: normals in separate files
        mv: motion vectors in separate files
        depth: depth in separate files
        pos: positions in separate files, in the world
        ids: ids of objects or meshes in separate files
        layers: name layers yourself, such as albedo=MyAOV.albedo or motion=Vec.X,Vec.Y
        motion: the motion vectors' convention, such as XY,+x,-y,pixels, in the notation that is printed
        ref: references to compare with
        frame_range: frame numbers to denoise
        reset_at: frame numbers at which history is reset
        quality: of OIDN
        stored_as: by default as in the input
        png: write a preview beside each frame
        spp: samples per pixel of the frames, of each buffer
        error: add the layer `error`, an estimate of each pixel's error; needs NAME+js and two sample buffers, and takes
            three passes instead of one
        until: print which frames have a relative error of at most E, such as 0.02, and how many samples others need
        device: where to compute
    """

    frames: Annotated[Patterns, Positional] = ()
    denoiser: Annotated[str, arg(metavar="DENOISER")] = "one"
    out: Annotated[Path, arg(metavar="DIR")] = Path("denoised")
    weights: Annotated[Path | None, arg(metavar="FILE", aliases=["-w"])] = None
    hdr: Patterns = ()
    half: Patterns = ()
    alb: Patterns = ()
    nrm: Patterns = ()
    mv: Patterns = ()
    depth: Patterns = ()
    pos: Patterns = ()
    ids: Patterns = ()
    layers: Annotated[tuple[str, ...], arg(metavar="QUANTITY=LAYER...")] = ()
    motion: Annotated[str | None, arg(metavar="PAIR,SIGNx,SIGNy,UNIT")] = None
    ref: Annotated[tuple[str, ...], arg(metavar="PATTERN...", aliases=["-r"])] = ()
    frame_range: Annotated[str | None, arg(name="frames", metavar="A-B")] = None
    reset_at: Annotated[tuple[int, ...], arg(metavar="N...")] = ()
    quality: Annotated[Literal["high", "balanced", "fast"] | None, arg(aliases=["-q"])] = None
    stored_as: Annotated[Literal["half", "float"] | None, arg(name="as")] = None
    png: Flag = False
    spp: Annotated[float, arg(metavar="N")] = 1.0
    error: Flag = False
    until: Annotated[float | None, arg(metavar="E")] = None
    device: Literal["cpu", "cuda"] = "cpu"

    @property
    def patterns(self) -> dict[str, Sequence[str]]:
        """The patterns of the files of each pass. Raises BadInput without any of colour."""
        colour = (*self.frames, *self.hdr)
        if not colour:
            raise BadInput("name the frames to denoise, such as 'frames/*.exr'")
        passes = {COLOUR: colour, "half": self.half, "albedo": self.alb, "normal": self.nrm, "motion": self.mv}
        passes |= {"depth": self.depth, "position": self.pos, "id": self.ids}
        return {name: patterns for name, patterns in passes.items() if patterns}

    @property
    def estimates_error(self) -> bool:
        return self.error or self.until is not None
