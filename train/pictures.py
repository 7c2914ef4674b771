"""Pictures of a training: a frame as the network denoises it, and the curve of the loss."""

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from datasets.clip import Clip
from datasets.frame import read_frame, to_tensor
from datasets.tonemap import display
from models.denoiser import Denoiser, State
from models.operators import finite
from train.log import METRICS_CSV, read_metrics

CURVE_FILE = "loss.png"
SAMPLE_FRAME = 7  # of a clip, or its last one: late enough for the state to have settled
AMPLIFIED = 4  # differences in sample pictures


@torch.no_grad()
def sample_picture(denoiser: Denoiser, clip: Clip, device: torch.device) -> Tensor:
    """Noisy, output, reference and amplified difference side by side as displayed, (3, H, 4 W), of one frame.

    The network runs over the frames before it too, as in use.
    """
    state: State | None = None
    last = min(SAMPLE_FRAME, clip.frames - 1)
    for index in range(last + 1):
        frame = read_frame(clip, index, denoiser.reads, in_layers=False)
        output, state = denoiser(frame.to(device), state)
    reference = to_tensor(clip.reference(last, denoiser.signal), has_buffers=True)[0].mean(dim=0, keepdim=True)
    images = (frame.radiance(denoiser.signal), finite(output).float().cpu(), reference)
    noisy, shown, truth = (display(image, clip.exposure)[0] for image in images)
    return torch.cat([noisy, shown, truth, (AMPLIFIED * (shown - truth).abs()).clamp(max=1)], dim=-1)


def loss_curve(folder: Path, title: str) -> None:
    """Draw loss.png from metrics.csv: the training loss and its parts, and the loss over the validation clips."""
    from plotting import DPI, plt, save_figure

    rows = read_metrics(folder / METRICS_CSV)
    figure, axis = plt.subplots(figsize=(7, 4.5), dpi=DPI, layout="constrained")
    other = {"step", "learning_rate", "gradient_norm", "step_ms", "loading_ms", "skipped", "val_loss"}
    for name in [name for name in rows[0] if name not in other]:
        points = smooth(np.array([(row["step"], row[name]) for row in rows if name in row]))
        axis.plot(*points.T, lw=1.8 if name == "loss" else 0.9, label=name)
    validation = np.array([(row["step"], row["val_loss"]) for row in rows if "val_loss" in row])
    axis.plot(*validation.T, "o-", color="black", ms=4, lw=0.8, label="loss on validation clips")
    axis.set(xlabel="step", ylabel="loss", title=title, yscale="log")
    axis.grid(alpha=0.3, which="both")
    axis.legend(fontsize=8)
    save_figure(folder / CURVE_FILE, figure)


def smooth(points: NDArray[np.float64], width: int = 50) -> NDArray[np.float64]:
    """Points (N, 2) as means of neighbours, fewer than 8 * `width` of them: single steps are too noisy to read."""
    size = max(1, len(points) // (width * 4))
    whole = points[: len(points) // size * size]
    return np.asarray(whole.reshape(-1, size, 2).mean(axis=1))
