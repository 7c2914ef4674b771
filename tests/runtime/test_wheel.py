"""The Python package of the C runtime: its wheel is small, needs numpy alone, and computes what the runtime does."""

import importlib
import os
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path
from shutil import which

import numpy as np
import pytest
import torch

from datasets.frame import Frame
from eval.bench.synthetic_frames import synthetic_frame
from runtime.raw import PLANES
from tests.helpers.c_runtime import CC, FOLDER, ISAS, STRICT, CRuntime
from tests.helpers.c_runtime import SOURCES as C_SOURCES

MOST_BYTES = 3_000_000
SIZE = (50, 72)
IMAGES = {"direct": "color", **{name: name for name in (*PLANES[1:], "mesh_id")}}
pytestmark = pytest.mark.skipif(not CC, reason="there is no C compiler")


# Plays frames with as many threads as an argument says, all of which lie as planes: no image is contiguous.
PLAY = """
import sys
sys.path[:0] = sys.argv[1:3]
import numpy as np
import onespp_runtime
assert "torch" not in sys.modules and onespp_runtime.__file__.startswith(sys.argv[1])
frames = np.load("frames.npz")
denoiser = onespp_runtime.Denoiser(72, 50, max_meshes=64, threads=int(sys.argv[3]))
assert denoiser.threads == int(sys.argv[3])
for index in range(int(frames["count"])):
    arrays = {name.split("/")[1]: frames[name] for name in frames.files if name.startswith(f"{index}/")}
    given = {name: np.moveaxis(array, 0, -1) if array.ndim == 3 and name != "object_to_world" else array
             for name, array in arrays.items()}
    np.save(f"{index}.npy", denoiser.denoise(**given, reset=index == 3))
"""

# A fork has no threads, but must neither hang nor compute anything else.
FORK = """
import os, sys
sys.path[:0] = sys.argv[1:3]
import numpy as np
import onespp_runtime
one, zero = np.ones((40, 40, 3), np.float32), np.zeros((40, 40, 3), np.float32)
camera = {"K": [[-9, 0, 20], [0, -9, 20], [0, 0, 1]], "camera_to_world": np.eye(4)}
denoiser = onespp_runtime.Denoiser(40, 40, threads=3)
denoise = lambda: denoiser.denoise(one, one, zero, one[..., 0], zero[..., :2], **camera, reset=True)
expected = denoise()
child = os.fork()
if child == 0:
    same = all(np.array_equal(denoise(), expected) for _ in range(3))
    del denoiser
    os._exit(0 if same else 1)
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


@pytest.fixture
def module(unpacked, monkeypatch):
    monkeypatch.syspath_prepend(unpacked)
    return importlib.import_module("onespp_runtime")


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    """With a frame of another size at the end."""
    return [*(synthetic_frame(index, *SIZE) for index in range(5)), synthetic_frame(5, 33, 50)]


@pytest.fixture(scope="module")
def expected(library, frames) -> list[np.ndarray]:
    """Radiance (H, W, 3) of the C runtime."""
    runtime = CRuntime(library, SIZE[1], SIZE[0])
    outputs = [runtime(frame, index in (0, 3)) for index, frame in enumerate(frames)]
    return [np.moveaxis(output[0].numpy(), 0, -1) for output in outputs]


def planes(frame: Frame) -> dict[str, np.ndarray]:
    """The arguments of `denoise`, with images (C, H, W)."""
    arrays = {ours: frame.channels[name][0].numpy() for name, ours in IMAGES.items()}
    now = frame.now
    arrays |= {name: getattr(now, name)[0].numpy() for name in ("K", "camera_to_world", "object_to_world")}
    return arrays | {"samples": np.float64(frame.samples.item())}


def arguments(frame: Frame) -> dict:
    """The same with images (H, W, C)."""
    return {name: np.moveaxis(a, 0, -1) if name in IMAGES.values() else a for name, a in planes(frame).items()}


@pytest.fixture(scope="module")
def numpy_alone(tmp_path_factory) -> Path:
    """A folder of packages with nothing but numpy."""
    folder = tmp_path_factory.mktemp("numpy")
    site = Path(np.__file__).parents[1]
    for name in ("numpy", "numpy.libs"):
        if (site / name).exists():
            (folder / name).symlink_to(site / name)
    return folder


def isolated(script: str, *arguments: object, cwd: Path) -> None:
    command = [sys.executable, "-I", "-S", "-c", script, *map(str, arguments)]
    subprocess.run(command, cwd=cwd, check=True, timeout=60)


def test_the_wheel_is_small_and_serves_every_python(wheel):
    version = tomllib.loads((FOLDER / "python" / "pyproject.toml").read_text())["project"]["version"]
    assert wheel.name.startswith(f"onespp_runtime-{version}-py3-none-")
    assert not wheel.name.endswith("any.whl") and wheel.stat().st_size <= MOST_BYTES
    names = zipfile.ZipFile(wheel).namelist()
    assert any(name.endswith("LICENSE") for name in names) and not any(name.endswith((".c", ".h")) for name in names)


@pytest.mark.slow
def test_a_source_distribution_has_all_it_needs(wheel, library, tmp_path):
    """As its manifest shows: what compiles the wheel lies below its folder."""
    command = [sys.executable, "setup.py", "-q", "sdist", "--formats=zip", "--dist-dir", str(tmp_path)]
    subprocess.run(command, cwd=wheel.parent / "runtime" / "python", check=True, capture_output=True)
    [archive] = tmp_path.glob("*.zip")
    names = {name.split("/", 1)[1] for name in zipfile.ZipFile(archive).namelist()}
    copies = {f"copies/{Path(name).name}" for name in (*C_SOURCES, "onespp.h", "onespp_weights.h", "LICENSE")}
    assert {"setup.py", "threads.c"} | copies <= names and not any(".." in name for name in names)


@pytest.mark.parametrize("threads", [1, 2])
def test_it_computes_what_the_c_runtime_does(unpacked, numpy_alone, frames, expected, threads, tmp_path):
    """Bit for bit, where no package but numpy can be imported."""
    arrays = {f"{index}/{name}": a for index, frame in enumerate(frames) for name, a in planes(frame).items()}
    np.savez(tmp_path / "frames.npz", count=len(frames), **arrays)
    isolated(PLAY, unpacked, numpy_alone, threads, cwd=tmp_path)
    for index, output in enumerate(expected):
        np.testing.assert_array_equal(np.load(tmp_path / f"{index}.npy"), output)


def test_the_example_smooths(unpacked, numpy_alone, tmp_path):
    [code] = re.findall(r"```python\n(.*?)```", (FOLDER / "README.md").read_text(), re.DOTALL)
    isolated(f"import sys; sys.path[:0] = sys.argv[1:3]\n{code}", unpacked, numpy_alone, cwd=tmp_path)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork")
def test_a_fork_works_without_threads(unpacked, numpy_alone, tmp_path):
    isolated(FORK, unpacked, numpy_alone, cwd=tmp_path)


def test_instruction_sets(module, library, frames, expected):
    """The fastest one is that of the C runtime; a lower one differs by rounding errors."""
    fastest, lowest = (module.Denoiser(SIZE[1], SIZE[0], max_meshes=64, max_isa=isa) for isa in ("any", "baseline"))
    assert lowest.isa == "baseline" and ISAS[fastest.isa] == CRuntime(library, 8, 8).isa
    output = lowest.denoise(**arguments(frames[0]))
    np.testing.assert_allclose(output, expected[0], rtol=0, atol=1e-5 * expected[0].max())


def test_arrays_of_any_library_and_layout(module, frames, expected):
    """Of PyTorch, of double and half precision where that loses nothing, upside down in memory, and not aligned."""

    def flipped(array: np.ndarray) -> np.ndarray:
        return array[::-1].copy()[::-1]

    def unaligned(array: np.ndarray) -> np.ndarray:
        packed = np.zeros(array.shape, [("byte", "u1"), ("value", array.dtype)])
        packed["value"] = array
        return packed["value"]

    kinds = {
        "torch": torch.from_numpy,
        "double": lambda array: array.astype(np.float64),
        "big endian": lambda array: array.astype(">f4"),
        "flipped": flipped,
        "unaligned": unaligned,
    }
    for change in kinds.values():
        denoiser = module.Denoiser(SIZE[1], SIZE[0], max_meshes=64, threads=2)
        for index, frame in enumerate(frames):
            given = {k: change(a) if k in IMAGES.values() else a for k, a in arguments(frame).items()}
            output = denoiser.denoise(**given, reset=index == 3)
            np.testing.assert_array_equal(output, expected[index])
    given = arguments(frames[0])
    half = torch.from_numpy(given["color"]).half()
    outputs = [denoiser.denoise(**(given | {"color": each}), reset=True) for each in (half, half.float())]
    np.testing.assert_array_equal(*outputs)


def test_tensors_of_drjit(module, frames, expected):
    drjit = pytest.importorskip("drjit")
    given = arguments(frames[0])
    given["color"] = drjit.scalar.TensorXf(np.ascontiguousarray(given["color"]))
    output = module.Denoiser(SIZE[1], SIZE[0], max_meshes=64).denoise(**given)
    np.testing.assert_array_equal(output, expected[0])


def test_strided_arrays_are_not_copied(unpacked, module):
    arrays = importlib.import_module("onespp_runtime.arrays")
    image = np.zeros((3, 8, 10), np.float32)
    for view in (np.moveaxis(image, 0, -1), np.moveaxis(image, 0, -1)[::-2, 1::3], torch.from_numpy(image).mT[..., 1:]):
        assert np.shares_memory(arrays.to_floats("color", view), image)


def test_as_a_function_with_a_state(module, frames, expected):
    """Without mesh ids and poses: the state is that of a Denoiser, which begins anew for a larger frame."""
    state = None
    for index in (0, 1, 2):
        output, state = module.denoise(**arguments(frames[index]), threads=2, state=state)
        np.testing.assert_array_equal(output, expected[index])
    large = arguments(synthetic_frame(0, 60, 80))
    output, larger = module.denoise(**large, state=state)
    assert larger is not state and larger.threads == state.threads
    np.testing.assert_array_equal(output, module.Denoiser(80, 60, max_meshes=64).denoise(**large))


def test_what_is_optional(module, frames):
    given = arguments(frames[0])
    ones, zeros = np.ones((*SIZE, 3), np.float32), np.zeros((*SIZE, 3), np.float32)
    denoiser = module.Denoiser(SIZE[1], SIZE[0], max_meshes=64)
    explicit = {"albedo": ones, "indirect": zeros, "emission": zeros, "roughness": ones[..., 0]}
    explicit["mesh_id"] = (given["depth"] > 0).astype(np.uint8)
    left_out = dict.fromkeys(explicit)
    outputs = [denoiser.denoise(**(given | changes), reset=True) for changes in (explicit, left_out)]
    np.testing.assert_array_equal(*outputs)


H, W = SIZE
BAD = {
    "no channels": (
        "color",
        np.zeros((H, W), np.float32),
        ValueError,
        r"color: expected shape \(H, W, 3\), got \(50, 72\)",
    ),
    "too large": (
        "color",
        np.zeros((H + 1, W, 3), np.float32),
        ValueError,
        r"color: \(H, W\) is \(51, 72\), but .*\(50, 72\)",
    ),
    "empty": ("color", np.zeros((0, W, 3), np.float32), ValueError, "color: expected shape"),
    "planes": (
        "normal",
        np.zeros((3, H, W), np.float32),
        ValueError,
        r"normal: expected shape \(50, 72, 3\), got \(3, 50, 72\)",
    ),
    "one column": (
        "depth",
        np.zeros((H, 1), np.float32),
        ValueError,
        r"depth: .*\(50, 72, 1\) or \(50, 72\), got \(50, 1\)",
    ),
    "bytes": ("albedo", np.zeros((H, W, 3), np.uint8), TypeError, "albedo: expected floats, got uint8"),
    "missing": ("motion", None, TypeError, "motion: expected floats, got object"),
    "gradient": ("color", torch.zeros(H, W, 3, requires_grad=True), TypeError, "color: Tensor is no array .* gradient"),
    "halves": ("mesh_id", np.full(SIZE, 0.5), ValueError, "mesh_id: expected whole numbers"),
    "wide": ("mesh_id", np.full(SIZE, 1 << 32), ValueError, "mesh_id: expected whole numbers"),
    "names": ("mesh_id", np.full(SIZE, "a"), TypeError, "mesh_id: expected integers"),
    "no camera": ("K", np.eye(4), ValueError, r"K: expected shape \(3, 3\), got \(4, 4\)"),
    "no lens": ("K", np.zeros((3, 3)), ValueError, "K: a focal length is not negative"),
    "to the right": ("K", np.diag([50.0, 50.0, 1.0]), ValueError, "K: a focal length is not negative"),
    "infinite": ("camera_to_world", np.full((4, 4), np.inf), ValueError, "camera_to_world: not all numbers are finite"),
    "scaled": ("object_to_world", 2 * np.eye(4)[None], ValueError, "object_to_world: expected rotation"),
    "transposed": ("camera_to_world", np.eye(4) + np.eye(4, k=-3), ValueError, "camera_to_world: expected rotation"),
    "one pose": (
        "object_to_world",
        np.eye(4),
        ValueError,
        r"object_to_world: expected shape \(M, 4, 4\), got \(4, 4\)",
    ),
    "many poses": ("object_to_world", np.tile(np.eye(4), (65, 1, 1)), ValueError, "65 poses, but max_meshes is 64"),
    "no samples": ("samples", 0.0, ValueError, r"samples: expected 0.001 to 1e\+09, got 0.0"),
    "nan": ("samples", np.nan, ValueError, "samples"),
}


@pytest.mark.parametrize("case", BAD)
def test_errors_name_the_array_and_leave_the_state(module, frames, expected, case):
    name, value, kind, message = BAD[case]
    denoiser = module.Denoiser(W, H, max_meshes=64)
    for index in (0, 1):
        np.testing.assert_array_equal(denoiser.denoise(**arguments(frames[index])), expected[index])
        with pytest.raises(kind, match=message):
            denoiser.denoise(**(arguments(frames[index]) | {name: value}), reset=True)


def test_errors_of_the_library(module):
    library = importlib.import_module("onespp_runtime.library")
    with pytest.raises(ValueError, match="a size, a number of samples or an image is missing"):
        library.check(4)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"width": 0}, "width: expected 1 to 16384, got 0"),
        ({"height": 1 << 40}, "height: expected"),
        ({"max_meshes": -1}, "max_meshes: expected"),
        ({"threads": 0}, "threads: expected 1 to 512, got 0"),
        ({"max_isa": "mmx"}, "max_isa: expected one of any, baseline, avx2, avx512, got 'mmx'"),
    ],
)
def test_bad_sizes(module, given, message):
    with pytest.raises(ValueError, match=message):
        module.Denoiser(**({"width": 8, "height": 8} | given))


@pytest.mark.parametrize("compiler", ["gcc", "clang"])
def test_threads_compile_without_warnings(compiler, tmp_path):
    if which(compiler) is None:
        pytest.skip(f"{compiler} is not installed")
    source = str(FOLDER / "python" / "threads.c")
    for flags in (("-Wpedantic",), ("-std=gnu17",), ("-U__unix__",)):  # the last as where there are no POSIX threads
        command = [compiler, *STRICT, *flags, f"-I{FOLDER}", "-c", source, "-o", str(tmp_path / "it.o")]
        subprocess.run(command, check=True)


def test_parts_of_the_light_are_denoised_in_place(module, frames):
    height, width = SIZE
    plain, denoiser = (module.Denoiser(width, height, max_meshes=64, max_parts=count) for count in (0, 2))
    for frame in frames[:3]:
        given = arguments(frame)
        light = np.asarray(given["color"]) + np.asarray(given["indirect"])
        parts = [np.ascontiguousarray(share * light, np.float32) for share in (0.25, 0.75)]
        radiance = denoiser.denoise(**given, parts=parts)
        assert np.array_equal(radiance, plain.denoise(**given))
        np.testing.assert_allclose(sum(parts) + np.asarray(given["emission"]), radiance, rtol=1e-4, atol=1e-5)


def test_a_mask_stays_what_it_is_when_light_changes(module, frames):
    denoiser = module.Denoiser(SIZE[1], SIZE[0], max_meshes=64, max_parts=1)
    for frame, brightness in zip(frames[:3], (1, 4, 1), strict=True):
        given = arguments(frame)
        given["color"] = brightness * np.asarray(given["color"])
        mask = np.ascontiguousarray(0.25 * np.maximum(given["albedo"], 0.01), np.float32)
        expected = mask.copy()
        denoiser.denoise(**given, parts=[mask], masks=1)
        np.testing.assert_allclose(mask, expected, rtol=1e-4)


@pytest.mark.parametrize(
    ("parts", "error", "message"),
    [
        ([np.zeros((*SIZE, 3))], TypeError, "float32"),
        ([np.zeros((*SIZE, 1), np.float32)], ValueError, "shape"),
        ([np.zeros((*SIZE, 3), np.float32)] * 3, ValueError, "max_parts is 2"),
        ([np.zeros(SIZE, [("b", "u1"), ("v", "f4", (3,))])["v"]], TypeError, "whole floats apart"),
    ],
)
def test_bad_parts(module, frames, parts, error, message):
    denoiser = module.Denoiser(SIZE[1], SIZE[0], max_meshes=64, max_parts=2)
    with pytest.raises(error, match=message):
        denoiser.denoise(**arguments(frames[0]), parts=parts)
