"""`onespp study error`: how close estimated errors are to true ones."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
import torch
from tabulate import tabulate
from torch import Tensor
from torch.nn.functional import avg_pool2d
from tqdm import tqdm

from datasets.channels import CAMERA_CHANNELS, NOISY_CHANNELS, REFERENCE_CHANNELS, SAMPLE_BUFFERS
from datasets.clip import Clip
from datasets.frame import Frame, read_frame, to_tensor
from datasets.tonemap import display
from errors import BadInput
from eval.selection import cannot_run, choose, weights_of
from eval.studies.own_clips import SEED, own_clip
from files import write_file, write_json
from models.denoiser import State
from models.registry import parse_name
from models.spec import DenoiserSpec, fastest_precision
from models.wrappers.error_estimate import ErrorEstimate, denoise_with_error
from models.wrappers.shrinkage import JamesStein
from plotting import DPI, Axes, Figure, plt, save_figure
from provenance import device_in_words
from render.clip import Sampling
from scenes.registry import build_scene

DEFAULT_DENOISERS = ("one+js", "oidn+js", "svgf+js")
CLIP_SCENES = ("cornell_box", "cornell_box_moving", "room-2002", "room-2004")
CLIP_SIZE = (12, 128, 128)  # frames, height, width
CLIP_SAMPLING = Sampling(realisations=64, noisy_spp=2, reference_spp=1024)
SURFACES = ("emission", "albedo", "normal", "depth", "roughness", "mesh_id", "motion", "dual_motion")
CLIP_CHANNELS = (*NOISY_CHANNELS, *REFERENCE_CHANNELS, *SURFACES, *CAMERA_CHANNELS)
LEVELS = (128, 64, 16, 4)  # samples per pixel; the error at the first is the target of predicted sample counts
BLOCK_PIXELS = 64  # side of the blocks over which, and over all frames, squared errors are averaged
BAND = (0.8, 1.25)  # estimated over true squared error
SHOWN = ("room-2002", 16)  # scene and samples per pixel of the picture


@dataclass(frozen=True)
class ErrorComparison:
    """One denoiser on one clip: squared errors in radiance of each block, and relative errors of the whole clip.

    Attributes:
        true: from the two sample buffers of the reference.
        estimated: from the two sample buffers of the input.
        mapped: from the error map, which is smoothed and never below 0.
        samples: predicted to reach the error with LEVELS[0]; the median over frames.
    """

    denoiser: str
    scene: str
    spp: int
    true: list[float]
    estimated: list[float]
    mapped: list[float]
    true_relative: float
    estimated_relative: float
    samples: float


def clip_of(scene: str, folder: Path) -> Clip:
    """The clip of a scene, rendered if missing."""
    return own_clip(
        folder, scene, lambda: build_scene(scene, SEED, CLIP_SIZE[0]), CLIP_SIZE, CLIP_SAMPLING, CLIP_CHANNELS
    )


def frame_with_samples(clip: Clip, index: int, spp: int, reads: Sequence[str]) -> Frame:
    """A frame with `spp` samples per pixel in two buffers, averaged from independent realisations."""
    frame = read_frame(clip, index, [name for name in reads if name not in NOISY_CHANNELS])
    realisations = range(spp // clip.facts["noisy_spp"])
    channels = dict(frame.channels)
    for name in NOISY_CHANNELS:
        drawn = np.stack([clip.read(name, index, realisation=i).astype(np.float32) for i in realisations])
        buffers = np.stack([part.mean(axis=0) for part in np.split(drawn, 2)])
        channels |= {name: to_tensor(buffers.mean(axis=0)), SAMPLE_BUFFERS[name]: to_tensor(buffers, has_buffers=True)}
    return replace(frame, channels=channels, spp=torch.full((1, 1, 1, 1), float(spp)))


def run_denoiser(denoiser: JamesStein, clip: Clip, spp: int) -> Iterator[tuple[Tensor, ErrorEstimate, Tensor]]:
    """Radiance, its error estimate, and the reference's sample buffers (2, 3, H, W), frame by frame."""
    state: State | None = None
    for index in range(clip.frames):
        output, state, estimate = denoise_with_error(
            denoiser, frame_with_samples(clip, index, spp, denoiser.reads), state
        )
        yield output, estimate, to_tensor(clip.reference(index, denoiser.signal), has_buffers=True)[0]


def compare_errors(denoiser: JamesStein, name: str, clip: Clip, spp: int, target: float | None) -> ErrorComparison:
    """Compare estimated and true errors on a clip; sample counts are predicted for `target`, by default its error."""
    squares: list[Tensor] = []  # of each frame true, estimated and mapped, (3, blocks)
    relative: list[tuple[float, float]] = []
    estimates = []
    for output, estimate, buffers in run_denoiser(denoiser, clip, spp):
        true = (output - buffers[:1]) * (output - buffers[1:])
        scale = estimate.radiance_scale
        images = torch.cat([true, estimate.squared_error * scale.square(), estimate.radiance_error().square()])
        squares.append(avg_pool2d(images.mean(dim=1, keepdim=True), BLOCK_PIXELS).flatten(1))
        over_unit = true / scale.square().clamp(min=1e-30)
        relative.append((estimate.surface_mean(over_unit), estimate.surface_mean(estimate.squared_error)))
        estimates.append(estimate)
    true_relative, estimated_relative = np.sqrt(np.maximum(np.mean(relative, axis=0), 0))
    true_blocks, estimated, mapped = torch.stack(squares).mean(dim=0).tolist()
    wanted = true_relative if target is None else target
    samples = float(np.median([estimate.samples_for(wanted) for estimate in estimates]))
    errors = true_blocks, estimated, mapped, float(true_relative), float(estimated_relative)
    return ErrorComparison(name, clip.scene, spp, *errors, samples)


def in_band(rows: Sequence[ErrorComparison], kind: str) -> float:
    """The share of blocks in which the ratio of `kind`, "estimated" or "mapped", to the true error is within BAND."""
    ratios = np.concatenate([np.array(getattr(row, kind)) / np.array(row.true) for row in rows])
    return float(((ratios >= BAND[0]) & (ratios <= BAND[1])).mean())


def table_of(rows: Sequence[ErrorComparison]) -> str:
    """One row per denoiser and number of samples, over all clips."""
    lines = []
    for denoiser, spp in dict.fromkeys((row.denoiser, row.spp) for row in rows):
        ours = [row for row in rows if (row.denoiser, row.spp) == (denoiser, spp)]
        ratios = [np.sum(getattr(row, kind)) / np.sum(row.true) for kind in ("estimated", "mapped") for row in ours]
        means = [float(np.exp(np.log(np.maximum(part, 1e-3)).mean())) for part in np.split(np.array(ratios), 2)]
        shares = [in_band(ours, kind) for kind in ("estimated", "mapped")]
        asked = "; ".join(f"{row.samples:.0f}" for row in ours)
        lines.append([denoiser, spp, *(f"{mean:.2f}" for mean in means), *(f"{share:.0%}" for share in shares), asked])
    heads = [
        *("denoiser", "spp", "estimate / true", "map / true", "blocks in band", "map's blocks in band"),
        f"predicted spp ({LEVELS[0]} needed)",
    ]
    return tabulate(lines, heads, tablefmt="github", disable_numparse=True)


def draw_errors(axis: Axes, rows: Sequence[ErrorComparison]) -> None:
    """Estimated against true errors of all blocks of one denoiser, and BAND."""
    for spp in LEVELS[::-1]:
        true, estimated = (
            np.sqrt(np.maximum(np.concatenate([getattr(row, kind) for row in rows if row.spp == spp]), 1e-10))
            for kind in ("true", "estimated")
        )
        axis.plot(true, estimated, "o", ms=3, label=f"{spp} spp")
    low, high = axis.get_xlim()
    line = np.geomspace(max(low, 1e-4), high, 2)
    axis.plot(line, line, color="grey", lw=0.8)
    axis.fill_between(line, *(line * np.sqrt(bound) for bound in BAND), color="grey", alpha=0.2)
    axis.set(xscale="log", yscale="log", title=rows[0].denoiser)
    axis.set(xlabel="true error of a block, radiance", ylabel="estimated")
    axis.legend(fontsize=8)


def draw_samples(axis: Axes, rows: Sequence[ErrorComparison]) -> None:
    """Predicted sample counts against those of the input, for all denoisers."""
    for name in dict.fromkeys(row.denoiser for row in rows):
        ours = [row for row in rows if row.denoiser == name and row.spp != LEVELS[0]]
        axis.plot([row.spp for row in ours], [row.samples for row in ours], "o", ms=4, label=name)
    axis.axhline(LEVELS[0], color="grey", lw=0.8)
    axis.set(xscale="log", yscale="log", title=f"predicted spp, {LEVELS[0]} needed", xlabel="spp of the input")
    for ticks, place in ((LEVELS[1:], axis.set_xticks), ((32, 64, 128, 256, 512), axis.set_yticks)):
        place(ticks, map(str, ticks))
    axis.minorticks_off()
    axis.legend(fontsize=8)


def calibration_figure(rows: Sequence[ErrorComparison]) -> Figure:
    """A panel of errors for each denoiser, and one of predicted sample counts."""
    names = list(dict.fromkeys(row.denoiser for row in rows))
    figure, axes = plt.subplots(1, len(names) + 1, figsize=(3.4 * (len(names) + 1), 3.6), dpi=DPI, layout="constrained")
    for axis, name in zip(axes[:-1], names, strict=True):
        draw_errors(axis, [row for row in rows if row.denoiser == name])
    draw_samples(axes[-1], rows)
    return figure


def map_figure(denoiser: JamesStein, clip: Clip, spp: int) -> Figure:
    """The last frame: denoised image, estimated error, and true error, averaged over 5 x 5 pixels."""
    *_, (output, estimate, buffers) = run_denoiser(denoiser, clip, spp)
    true = avg_pool2d((output - buffers[:1]) * (output - buffers[1:]), 5, 1, 2, count_include_pad=False)
    errors = [image.mean(dim=1)[0].clamp(min=0).sqrt() for image in (estimate.radiance_error().square(), true)]
    figure, axes = plt.subplots(1, 3, figsize=(10, 3.5), dpi=DPI, layout="constrained")
    axes[0].imshow(display(output, clip.exposure)[0].permute(1, 2, 0))
    axes[0].set_title(f"denoised, {spp} spp")
    for axis, error, title in zip(axes[1:], errors, ("estimated error", "true error"), strict=True):
        picture = axis.imshow(error, cmap="magma", vmin=0, vmax=float(torch.quantile(errors[1], 0.99)))
        axis.set_title(title)
    figure.colorbar(picture, ax=axes[1:], label="radiance")
    for axis in axes:
        axis.set_axis_off()
    return figure


def error_estimators(names: Sequence[str], runs: Path) -> dict[str, JamesStein]:
    """The named denoisers, or those of DEFAULT_DENOISERS that can run, ready to use.

    Raises BadInput for an unknown one, one that cannot run or is not trained, and one that is not a NAME+js.
    """
    found = {}
    for name in choose(names, map(parse_name, DEFAULT_DENOISERS), cannot_run):
        denoiser = DenoiserSpec(name, "total", fastest_precision(name), weights_of(name, runs)).build()
        if not isinstance(denoiser, JamesStein):
            raise BadInput(f"{name} does not estimate its error, {name}+js does")
        found[str(name)] = denoiser
    return found


@torch.inference_mode()
def study_error(runs: Path, names: Sequence[str]) -> str:
    """Compare estimated and true errors; writes clips, table.md, two PNGs and results.json to RUNS/study/error.

    Returns the table. Raises BadInput for an unknown denoiser and one that cannot run or is not trained.
    """
    folder = runs / "study" / "error"
    denoisers = error_estimators(names, runs)
    clips = [clip_of(scene, folder) for scene in tqdm(CLIP_SCENES, "clips", unit="clip")]
    rows: list[ErrorComparison] = []
    with tqdm(total=len(denoisers) * len(clips) * len(LEVELS), desc="errors", unit="clip") as progress:
        for (name, denoiser), clip in product(denoisers.items(), clips):
            target = None
            for spp in LEVELS:
                rows.append(compare_errors(denoiser, name, clip, spp, target))
                target = target or rows[-1].true_relative
                progress.update()
    save_figure(folder / "calibration.png", calibration_figure(rows))
    scene, spp = SHOWN
    save_figure(folder / "map.png", map_figure(next(iter(denoisers.values())), clips[CLIP_SCENES.index(scene)], spp))
    table = table_of(rows)
    write_file(folder / "table.md", f"{table}\n".encode())
    write_json(
        folder / "results.json", {"schema": 1, "device": device_in_words(), "rows": [asdict(row) for row in rows]}
    )
    return table
