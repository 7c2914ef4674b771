"""Real frames of a real renderer: Cycles renders a room at 1 spp, and we denoise what it calls `Noisy Image`."""

import subprocess
from pathlib import Path

import numpy as np
import pytest

from command_line import main
from datasets.tonemap import display, psnr
from denoise.exr_image import ExrImage
from provenance import ROOT

BLENDER = ROOT / ".venv-blender" / "bin" / "python"
FRAMES = 12
SIZE = "240x135"
REFERENCE_SPP = 64
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def cycles(tmp_path_factory):
    """Noisy frames with Cycles' own denoised image, references, and the noisy ones denoised by `one`."""
    if not BLENDER.exists():
        pytest.fail("needs Blender's Python module: `make blender`, or `make test-all BLENDER=` to go without")
    folder = tmp_path_factory.mktemp("cycles")
    script = Path(__file__).with_name("render_room.py")
    arguments = [BLENDER, script, folder, str(FRAMES), SIZE, str(REFERENCE_SPP)]
    subprocess.run(arguments, check=True, stdout=subprocess.DEVNULL)
    main(["denoise", str(folder / "noisy" / "*.exr"), "--denoiser", "one", "--out", str(folder / "one")])
    return folder


def image(path, layer):
    """A layer (H, W, 3) as displayed."""
    exr = ExrImage(path)
    name = next(channel for channel in exr.channels if channel.endswith(f"{layer}.R")).removesuffix(".R")
    return display(exr.stacked([f"{name}.{c}" for c in "RGB"]).astype(np.float64), 1.0)


def quality(folder, path, layer):
    """PSNR of each frame against the reference."""
    names = [f"{frame:04d}.exr" for frame in range(1, FRAMES + 1)]
    references = [image(folder / "reference" / name, "Combined") for name in names]
    return [
        psnr(float(((image(path / name, layer) - r) ** 2).mean())) for name, r in zip(names, references, strict=True)
    ]


def test_frames_of_cycles_are_denoised_with_history(cycles, capsys):
    noisy = quality(cycles, cycles / "noisy", "Noisy Image")
    blender = quality(cycles, cycles / "noisy", "Combined")
    ours = quality(cycles, cycles / "one", "Combined")
    with capsys.disabled():
        print("\nPSNR by frame: 1 spp, Blender's OIDN, one")
        for row in zip(noisy, blender, ours, strict=True):
            print("  ".join(f"{value:.2f}" for value in row))
    assert min(np.subtract(ours, noisy)) > 6
    # History, and albedo supersampled along with it, make up for the start.
    assert np.mean(np.subtract(ours, blender)[9:]) > 1
