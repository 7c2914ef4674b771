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
LAYERS_HELP = "name layers yourself, such as albedo=MyAOV.albedo or motion=Vec.X,Vec.Y"
MOTION_HELP = "the motion vectors' convention, such as XY,+x,-y,pixels, in the notation that is printed"
AOV_HELP = (
    "denoise these layers of the colour's files too, by the kernels of the colour: lights that add up to it, or single "
    "channels such as A; needs --denoiser one"
)
ALBEDO_HELP = (
    "whether albedo is free of noise and antialiased, or has the light's samples at random places of the pixel and is "
    "averaged over frames; by default sampled for Cycles' Denoising Albedo"
)
ERROR_HELP = (
    "add the layer `error`, an estimate of each pixel's error; needs NAME+js and two sample buffers, and takes three "
    "passes instead of one"
)
UNTIL_HELP = "print which frames have a relative error of at most E, such as 0.02, and how many samples others need"


@dataclass(frozen=True)
class Job:
    """A sequence to denoise."""

    frames: Annotated[Patterns, Positional, arg(help="files with the colour, usually with all layers")] = ()
    denoiser: Annotated[str, arg(metavar="DENOISER", help="NETWORK@BUDGET for weights in RUNS")] = "one"
    out: Annotated[Path, arg(metavar="DIR", help="output folder; frames keep their names")] = Path("denoised")
    weights: Annotated[Path | None, arg(metavar="FILE", aliases=["-w"], help="by default the shipped ones")] = None
    hdr: Annotated[Patterns, arg(help="files with the colour, as PATTERN")] = ()
    buffer_b: Annotated[Patterns, arg(help="sample buffer B of the same frames, for NAME+js")] = ()
    alb: Annotated[Patterns, arg(help="albedo in separate files")] = ()
    nrm: Annotated[Patterns, arg(help="normals in separate files")] = ()
    mv: Annotated[Patterns, arg(help="motion vectors in separate files")] = ()
    depth: Annotated[Patterns, arg(help="depth in separate files")] = ()
    pos: Annotated[Patterns, arg(help="positions in separate files, in the world")] = ()
    ids: Annotated[Patterns, arg(help="ids of objects or meshes in separate files")] = ()
    layers: Annotated[tuple[str, ...], arg(metavar="QUANTITY=LAYER...", help=LAYERS_HELP)] = ()
    aov: Annotated[tuple[str, ...], arg(metavar="LAYER...", help=AOV_HELP)] = ()
    motion: Annotated[str | None, arg(metavar="PAIR,SIGNx,SIGNy,UNIT", help=MOTION_HELP)] = None
    albedo: Annotated[Literal["exact", "sampled"] | None, arg(metavar="{exact,sampled}", help=ALBEDO_HELP)] = None
    ref: Annotated[Patterns, arg(aliases=["-r"], help="references to compare with")] = ()
    frame_range: Annotated[str | None, arg(name="frames", metavar="A-B", help="frame numbers to denoise")] = None
    reset_at: Annotated[tuple[int, ...], arg(metavar="N...", help="frame numbers at which history is reset")] = ()
    quality: Annotated[
        Literal["high", "balanced", "fast"] | None,
        arg(metavar="{high,balanced,fast}", aliases=["-q"], help="of OIDN, where it is the denoiser"),
    ] = None
    stored_as: Annotated[Literal["half", "float"] | None, arg(name="as", help="by default as in the input")] = None
    png: Annotated[Flag, arg(help="write a preview beside each frame")] = False
    spp: Annotated[float, arg(metavar="N", help="samples per pixel of the frames, of each buffer")] = 1.0
    error: Annotated[Flag, arg(help=ERROR_HELP)] = False
    until: Annotated[float | None, arg(metavar="E", help=UNTIL_HELP)] = None
    device: Annotated[Literal["cpu", "cuda"], arg(help="where to compute")] = "cpu"

    @property
    def patterns(self) -> dict[str, Sequence[str]]:
        """The patterns of the files of each pass. Raises BadInput without any of colour."""
        colour = (*self.frames, *self.hdr)
        if not colour:
            raise BadInput("name the frames to denoise, such as 'frames/*.exr'")
        passes = {COLOUR: colour, "buffer_b": self.buffer_b, "albedo": self.alb, "normal": self.nrm, "motion": self.mv}
        passes |= {"depth": self.depth, "position": self.pos, "id": self.ids}
        return {name: patterns for name, patterns in passes.items() if patterns}
