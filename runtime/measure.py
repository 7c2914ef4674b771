"""Size, time to build, milliseconds and memory of each form of `one`, beside OIDN, in one run.

`python -m runtime.measure [WxH [RUNS]]` prints a table and writes RUNS/runtime/results.json; by default 1280x720 and
runs. It needs a C compiler, onespp[export] and onespp[oidn]. WebAssembly is left out without Clang for it or Node.js.
"""

import importlib
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from shutil import which
from statistics import median
from typing import Any

import torch
from tqdm import tqdm

from datasets.frame import Frame
from errors import BadInput
from eval.bench.denoisers import FEWEST_FRAMES, WARM_UP_FRAMES, parse_size, size_name
from eval.bench.memory import alone, growth_mb
from eval.bench.synthetic_frames import synthetic_frame
from eval.pages import form_table
from files import write_json
from models.export.package import load_step
from models.export.program import check_installed, play, run_onnx, trace, write_onnx
from models.networks.one import One
from models.registry import require_shipped, shipped_weights
from models.spec import DenoiserSpec, bfloat16_is_faster
from process import keep_freed_memory
from provenance import device_in_words
from runtime.raw import PLANES, raw
from runtime.script import exits_in_words
from runtime.wheel import build_wheel
from timing import take_turns

OIDN = ("oidn", "oidn-balanced", "oidn-fast")
ISAS = {"avx512": "AVX-512", "avx2": "AVX2", "baseline": "baseline"}
MESHES = 64  # at least those of synthetic frames
SMALL = 128  # px, the side of frames that only load code

Play = Callable[[Sequence[Frame]], Iterator[object]]  # denoises one frame for each result that it is asked for

# Plays the raw frames of a file, each once a line arrives.
NODE = """
const [module, file, width, height, meshes, size] = process.argv.slice(1), fs = require("fs");
const runtime = new WebAssembly.Instance(new WebAssembly.Module(fs.readFileSync(module))).exports;
runtime._initialize();
const address = runtime.create(+width, +height, +meshes), frames = fs.openSync(file);
const frame = new Uint8Array(runtime.memory.buffer, address, +size);
require("readline").createInterface({ input: process.stdin }).on("line", () => {
  if (fs.readSync(frames, frame) !== frame.length || !runtime.denoise()) throw new Error("a frame is damaged");
  console.log("done");
});
"""


@dataclass(frozen=True)
class Form:
    """A way to include a denoiser in a program."""

    name: str
    megabytes: float  # beside Python and numpy
    build_seconds: float | None
    play: Play
    in_process: bool = True  # so that its memory can be measured


def play_library(spec: DenoiserSpec, frames: Sequence[Frame], in_c: bool = True) -> Iterator[object]:
    """As the library runs it, or, for `one` without C, by PyTorch and Numba."""
    denoiser, state = spec.build(), None
    if isinstance(denoiser, One) and not in_c:
        denoiser.in_c = None
    for frame in frames:
        radiance, state = denoiser(frame, state)
        yield radiance


def denoiser_of(package: Path) -> Any:
    """The class of the wheel unpacked in a folder."""
    if str(package) not in sys.path:
        sys.path.insert(0, str(package))
    return importlib.import_module("onespp_runtime").Denoiser


def play_wheel(package: Path, max_isa: str, frames: Sequence[Frame]) -> Iterator[object]:
    height, width = frames[0].size
    denoiser = denoiser_of(package)(width, height, max_meshes=MESHES, threads=torch.get_num_threads(), max_isa=max_isa)
    for frame in frames:
        images = {name: frame.channels[name][0].movedim(0, -1).numpy() for name in (*PLANES, "mesh_id")}
        poses = {name: getattr(frame.now, name)[0].numpy() for name in ("K", "camera_to_world", "object_to_world")}
        yield denoiser.denoise(images.pop("direct"), **images, **poses, samples=frame.samples.item())


def play_onnx(path: Path, frames: Sequence[Frame]) -> Iterator[object]:
    step = load_step("one", require_shipped("one"), torch.float32, "inside")
    return play(step, frames, run_onnx(path))


def play_wasm(module: Path, frames: Sequence[Frame]) -> Iterator[object]:
    """The time of a frame includes reading it."""
    height, width = frames[0].size
    with tempfile.NamedTemporaryFile() as file:
        contents = [raw(frame, reset=index == 0) for index, frame in enumerate(frames)]
        Path(file.name).write_bytes(b"".join(contents))
        meshes = frames[0].now.object_to_world.shape[1]
        numbers = map(str, (width, height, meshes, len(contents[0])))
        command = ["node", "-e", NODE, str(module), file.name, *numbers]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as node:
            assert node.stdin and node.stdout
            for _ in frames:
                print(file=node.stdin, flush=True)
                if not node.stdout.readline():
                    raise BadInput("Node.js could not run the runtime as WebAssembly")
                yield None


def installed_mb(*packages: str) -> float:
    """Raises BadInput where one is missing."""
    try:
        files = [file.locate() for name in packages for file in distribution(name).files or ()]
    except PackageNotFoundError as missing:
        raise BadInput(f"{missing.name} is missing: `pip install 'onespp[export,oidn]'`") from None
    return sum(Path(str(file)).stat().st_size for file in files if Path(str(file)).is_file()) / 1e6


def file_mb(path: Path) -> float:
    return path.stat().st_size / 1e6


def made(product: str, folder: Path) -> tuple[Path, float]:
    """A target of the Makefile in FOLDER/runtime, and the seconds it takes. Raises BadInput where that fails."""
    start = time.perf_counter()
    try:
        done = subprocess.run(["make", "-B", product], cwd=folder / "runtime", capture_output=True, text=True)
    except FileNotFoundError:
        raise BadInput("make is missing") from None
    if done.returncode:
        raise BadInput(f"`make {product}` failed: {done.stderr.strip()[-300:]}")
    return folder / "runtime" / product, time.perf_counter() - start


def c_forms(folder: Path) -> Iterator[Form]:
    """Those of the C runtime, compiled from copies. All run as the wheel, through ctypes."""
    start = time.perf_counter()
    wheel = build_wheel(folder)
    wheel_seconds = time.perf_counter() - start
    package = folder / "package"
    zipfile.ZipFile(wheel).extractall(package)
    library, seconds = made("libonespp.so", folder)
    available = [isa for isa in ISAS if denoiser_of(package)(1, 1, max_isa=isa).isa == isa]
    for isa in available:
        yield Form(f"C, {ISAS[isa]}", file_mb(library), seconds, partial(play_wheel, package, isa))
    yield Form("Python wheel", file_mb(wheel), wheel_seconds, partial(play_wheel, package, "any"))
    if which("node"):
        try:
            module, seconds = made("web/onespp.wasm", folder)
        except BadInput as missing:
            print(missing, file=sys.stderr)
        else:
            play_module = partial(play_wasm, module)
            yield Form("WebAssembly, one thread", file_mb(module), seconds, play_module, in_process=False)


def onnx_form(folder: Path) -> Form:
    """Raises BadInput without onespp[export]."""
    check_installed("onnx")
    start, path = time.perf_counter(), folder / "one.onnx"
    step = load_step("one", require_shipped("one"), torch.float32, "inside")
    write_onnx(trace(step, synthetic_frame(0, SMALL, SMALL)), step, path)
    seconds = time.perf_counter() - start
    return Form("ONNX", file_mb(path) + installed_mb("onnxruntime"), seconds, partial(play_onnx, path))


def library_forms() -> Iterator[Form]:
    megabytes = installed_mb("torch", "numba", "llvmlite")
    fast = ["bfloat16"] if bfloat16_is_faster() else []
    forms = {"onespp": "float32"} | {f"PyTorch, {precision}": precision for precision in (*fast, "float32")}
    for name, precision in forms.items():
        spec = DenoiserSpec.named("one", precision=precision, weights=shipped_weights("one"))
        yield Form(name, megabytes, None, partial(play_library, spec, in_c=name == "onespp"))


def oidn_forms() -> Iterator[Form]:
    for name in OIDN:
        yield Form(name, installed_mb("pyoidn"), None, partial(play_library, DenoiserSpec.named(name)))


@torch.inference_mode()
def peak_mb(play: Play, height: int, width: int, threads: int) -> float | None:
    """Growth of memory during two frames, from the denoiser's making on, in MB; call it in a fresh process."""
    keep_freed_memory()
    torch.set_num_threads(threads)
    small, frames = ([synthetic_frame(i, *size) for i in range(2)] for size in ((SMALL, SMALL), (height, width)))
    list(play(small))  # loads code
    return growth_mb(lambda: list(play(frames)))


@torch.inference_mode()
def measure(forms: Sequence[Form], height: int, width: int) -> list[dict[str, Any]]:
    """A row of each form, which takes turns with OIDN, frame by frame."""
    frames = [synthetic_frame(index, height, width) for index in range(WARM_UP_FRAMES + FEWEST_FRAMES)]
    [baseline] = (form for form in forms if form.name == OIDN[0])
    rows = []
    for form in tqdm(forms, "forms"):
        turns = {each.name: partial(next, each.play(frames)) for each in (form, baseline)}
        seconds = take_turns(turns, FEWEST_FRAMES, WARM_UP_FRAMES)
        del turns  # and with it what it denoises with
        memory = alone(peak_mb, form.play, height, width, torch.get_num_threads()) if form.in_process else None
        facts = {"form": form.name, "megabytes": form.megabytes, "build_seconds": form.build_seconds}
        times = {key: 1e3 * median(seconds[name]) for key, name in (("ms", form.name), ("oidn_ms", baseline.name))}
        rows.append(facts | times | {"peak_mb": memory})
    return rows


def main(size: str = "1280x720", runs: str = "runs") -> None:
    """Raises BadInput for what is no size, and where something cannot be built."""
    height, width = parse_size(size)
    keep_freed_memory()
    with tempfile.TemporaryDirectory() as folder:
        forms = [*library_forms(), *c_forms(Path(folder)), onnx_form(Path(folder)), *oidn_forms()]
        rows = measure(forms, height, width)
    facts = {"device": device_in_words(threads=torch.get_num_threads()), "size": size_name((height, width))}
    path = Path(runs) / "runtime" / "results.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, {"schema": 1, **facts, "rows": rows})
    print(form_table(rows))


if __name__ == "__main__":
    if len(sys.argv) > 3 or any(text.startswith("-") for text in sys.argv):
        sys.exit(__doc__)
    with exits_in_words():
        main(*sys.argv[1:])
