"""`onespp bench light`: how many frames a denoiser lags after a light changes."""

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from tabulate import tabulate
from tqdm import tqdm

from datasets.channels import CHANNELS
from datasets.clip import Clip, is_clip
from datasets.frame import to_tensor
from datasets.tonemap import display, psnr
from eval.clip_run import play
from eval.selection import evaluated
from files import write_file, write_json
from models.denoiser import Denoiser
from models.operators import finite
from plotting import DPI, Figure, plt, save_figure
from provenance import device_in_words
from render.clip import Sampling, write_clip
from render.job.plan import GENERATOR
from scenes.animation import KeyframedTrack, RigidMotion, Scene, Track
from scenes.camera import Array
from scenes.registry import build_scene

CHANGE = 8  # the first frame in the new light
AFTER = (0, 1, 2, 4, 8)  # frames after it that the table shows
LIGHT_CLIP_SIZE = (CHANGE + AFTER[-1] + 1, 128, 128)  # frames, height, width
LIGHT_CLIP_SAMPLING = Sampling(realisations=1, noisy_spp=1, reference_spp=1024)
LIGHT_SCENE = "cornell_box"
STEADY = "still"
# The lamp before the change: the factor of its radiance, and its displacement.
BEFORE: dict[str, tuple[float, tuple[float, float, float]]] = {
    STEADY: (1.0, (0.0, 0.0, 0.0)),
    "switched-on": (0.05, (0.0, 0.0, 0.0)),
    "switched-down": (8.0, (0.0, 0.0, 0.0)),
    "moved": (1.0, (0.6, 0.0, -0.5)),
}

Lag = dict[str, list[float]]  # PSNR in dB of every frame of one denoiser, by the name of the change


def loss(lag: Lag, after: int) -> float:
    """The largest loss of PSNR against unchanged light, in dB, `after` frames after the change."""
    frame = CHANGE + after
    return max(lag[STEADY][frame] - psnr[frame] for change, psnr in lag.items() if change != STEADY)


def stepped(before: Array, after: Array) -> Track:
    """A step from one value to another between two frames."""
    times = np.array([CHANGE - 1.0, CHANGE])
    return KeyframedTrack(np.array([before, after]), times=times, straight=True)


def changed(change: str) -> Scene:
    """The Cornell box, whose lamp has its usual radiance and position from frame CHANGE on."""
    scene = build_scene(LIGHT_SCENE, 0, LIGHT_CLIP_SIZE[0])
    *others, lamp = scene.shapes
    gain, shift = BEFORE[change]
    assert lamp.radiance is not None and isinstance(lamp.motion, RigidMotion)
    radiance = lamp.radiance.at(0)
    place = lamp.motion.position.at(0)
    motion = replace(lamp.motion, position=stepped(place + shift, place))
    lamp = replace(lamp, radiance=stepped(gain * radiance, radiance), motion=motion)
    return replace(scene, shapes=(*others, lamp))


def clip_of(change: str, folder: Path) -> Clip:
    """The clip of a change, rendered if missing, in a folder named by a digest of everything that determines it."""
    name = f"{LIGHT_SCENE}-{change}"
    made_of = GENERATOR, name, LIGHT_CLIP_SIZE, LIGHT_CLIP_SAMPLING, *CHANNELS, CHANGE, BEFORE[change]
    path = folder / f"{zlib.crc32(repr(made_of).encode()):08x}" / name / "000"
    if not is_clip(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_clip(path, changed(change), LIGHT_CLIP_SIZE, LIGHT_CLIP_SAMPLING, 0, tuple(CHANNELS))
    return Clip(path)


@torch.inference_mode()
def psnr_of_frames(denoiser: Denoiser, clip: Clip, exposure: float) -> list[float]:
    """PSNR in dB of each displayed frame, for the signal that the denoiser returns."""
    values = []
    for index, _, (output,) in play(clip, [denoiser]):
        reference = to_tensor(clip.reference(index, denoiser.signal).mean(axis=0))
        error = display(finite(output), exposure) - display(reference, exposure)
        values.append(psnr(error.square().mean().item()))
    return values


def lag_table(lags: Mapping[str, Lag]) -> str:
    """One row per denoiser, sorted by the loss in the last column."""
    heads = ["denoiser", f"steady light, frame {LIGHT_CLIP_SIZE[0] - 1}", *(f"loss {n} frames after" for n in AFTER)]
    rows = [
        [name, f"{lag[STEADY][-1]:.1f} dB", *(f"{loss(lag, n):.1f} dB" for n in AFTER)]
        for name, lag in sorted(lags.items(), key=lambda item: loss(item[1], AFTER[-1]))
    ]
    return tabulate(rows, heads, tablefmt="github", disable_numparse=True)


def lag_figure(lags: Mapping[str, Lag]) -> Figure:
    size = (3 * len(BEFORE), 4)
    figure, axes = plt.subplots(1, len(BEFORE), figsize=size, dpi=DPI, layout="constrained", sharey=True)
    for axis, change in zip(axes, BEFORE, strict=True):
        for name, lag in lags.items():
            axis.plot(lag[change], label=name)
        axis.axvline(CHANGE, color="grey", lw=0.8, ls=":")
        axis.set(title=change, xlabel="frame")
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("PSNR dB")
    axes[0].legend(fontsize=8, loc="lower right")
    return figure


def bench_light(runs: Path, names: Sequence[str], budget: str) -> str:
    """Measure the lag of denoisers, by default of all that can run; writes RUNS/bench/light.

    Returns the table. Raises BadInput for an unknown denoiser and one that cannot run or is not trained.
    """
    specs = evaluated(names, runs, budget)
    folder = runs / "bench" / "light"
    clips = {change: clip_of(change, folder) for change in BEFORE}
    exposure = clips[STEADY].exposure  # of all clips
    lags = {}
    for spec in tqdm(specs, "denoisers", unit="denoiser"):
        denoiser = spec.build()
        name = spec.name if spec.returns == "total" else f"{spec.name} ({spec.returns})"
        lags[name] = {change: psnr_of_frames(denoiser, clip, exposure) for change, clip in clips.items()}
    save_figure(folder / "plot.png", lag_figure(lags))
    table = lag_table(lags)
    write_file(folder / "table.md", f"{table}\n".encode())
    rows = [{"denoiser": name, "psnr": lag} for name, lag in lags.items()]
    write_json(folder / "results.json", {"schema": 1, "device": device_in_words(), "rows": rows})
    return table
