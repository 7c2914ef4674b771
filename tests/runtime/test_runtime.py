"""The C runtime is `one`: frame by frame, at any size, on any number of threads, and whatever the frames contain."""

import ctypes
import runpy
import subprocess
import sys
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from shutil import copytree, which

import numpy as np
import pytest
import torch
from torch import Tensor

from datasets.clip import Dataset
from datasets.frame import BOUNDED, Frame, read_frame
from eval.bench.synthetic_frames import synthetic_frame
from models.compiled.one_in_c import in_order
from models.denoiser import State
from models.networks.one import HISTORY, One
from models.registry import require_shipped
from runtime.raw import write_raw
from runtime.weights import HEADER, header
from tests.helpers.c_runtime import (
    ABI,
    CC,
    FOLDER,
    ISAS,
    OPTIMISED,
    SOURCES,
    STRICT,
    CFrame,
    Config,
    CRuntime,
    Image,
    Library,
    Task,
    address,
    build,
    rounded_one,
    strided,
)
from tests.helpers.frames import MESHES, chain, flat_frame

TOLERANCE = 1e-4  # of the brightest pixel
SIZE = (40, 56)
ISA_TOLERANCE = 1e-5
STRIPS = "-DONESPP_STRIP_PIXELS=1"  # of 64 rows

INTERFACE = {"onespp_history_size", "onespp_denoise_from", "onespp_read_history", "onespp_create_with"}
INTERFACE |= {f"onespp_{name}" for name in ("abi", "size", "create", "denoise", "isa", "message")}

pytestmark = pytest.mark.skipif(not CC, reason="there is no C compiler")


@pytest.fixture(scope="module")
def in_strips(tmp_path_factory) -> Library:
    return build(tmp_path_factory.mktemp("strips") / "libonespp.so", SOURCES, (*OPTIMISED, STRIPS))


@pytest.fixture(params=["baseline", "avx2", "avx512 in strips"])
def limited(request, library, monkeypatch) -> Library:
    """The runtime with each instruction set that this machine has."""
    isa, _, strips = request.param.partition(" ")
    monkeypatch.setattr(library, "max_isa", ISAS[isa])
    if CRuntime(library, 8, 8).isa != library.max_isa:
        pytest.skip(f"there is no {isa} here")
    if strips:
        library = request.getfixturevalue("in_strips")
        monkeypatch.setattr(library, "max_isa", ISAS[isa])
    return library


@pytest.fixture(scope="module")
def one() -> One:
    return rounded_one()


@pytest.fixture
def frames() -> list[Frame]:
    return synthetic(4)


def synthetic(count: int, size: tuple[int, int] = SIZE, first: int = 0) -> list[Frame]:
    return [synthetic_frame(first + index, *size) for index in range(count)]


@torch.no_grad()
def compare(library: Library, one: One, frames: Iterable[Frame], resets: Sequence[int] = (0,)) -> float:
    """The largest difference of the sequence, relative to the brightest pixel of its frame."""
    runtime = CRuntime(library, 600, 200, parts=3)
    state: State | None = None
    worst = 0.0
    for index, frame in enumerate(frames):
        expected, state = one(frame, None if index in resets else state)
        actual = runtime(frame, index in resets)
        difference = (actual - expected).abs().amax() / expected.abs().amax().clamp(min=1e-6)
        worst = max(worst, difference.item())
        assert difference <= TOLERANCE, f"frame {index} differs by {difference:.1e} of the brightest pixel"
        if frame.parts is not None:
            parts = one.parts(frame.finite(), state)
            torch.testing.assert_close(runtime.parts, parts, rtol=0, atol=TOLERANCE * float(parts.abs().amax()))
    return worst


def test_the_array_of_weights_is_that_of_the_shipped_ones():
    assert header(require_shipped("one")) == HEADER.read_text(), "run `python -m runtime.weights`"


@pytest.mark.parametrize("name", ["gcc", "clang"])
@pytest.mark.parametrize("file", [*(source.name for source in SOURCES), "example.c", "fuzz.c"])
def test_compiles_without_warnings(name, file, tmp_path):
    if which(name) is None:
        pytest.skip(f"{name} is not installed")
    for flags in (("-Wpedantic",), ("-std=gnu17", "-DONESPP_DISPATCH")):  # gnu17 declares more names
        command = [name, *STRICT, *flags, "-c", str(FOLDER / file), "-o", str(tmp_path / "it.o")]
        subprocess.run(command, check=True)


@pytest.mark.parametrize("file", [source.name for source in SOURCES])
def test_it_neither_allocates_nor_has_global_state(file, objects):
    """As its symbols show: nothing of stdlib.h, and all that is not code is constant, relocated addresses too."""
    if which("nm") is None:
        pytest.skip("nm is not installed")
    command = ["nm", "--format=sysv", objects[file]]
    table = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    symbols = [[cell.strip() for cell in line.split("|")] for line in table.splitlines() if line.count("|") == 6]
    sections = {row[6] for row in symbols} - {"Section", "*UND*"}
    assert sections and all(section.startswith((".text", ".rodata", ".data.rel.ro")) for section in sections)
    assert {name for name, _, kind, *_ in symbols if kind == "T"} == (INTERFACE if file == "onespp.c" else set())
    needed = {name for name, _, kind, *_ in symbols if kind == "U"}
    engines = {"onespp_avx2", "onespp_avx512"}
    of_the_compiler = {"__cpu_model", "_GLOBAL_OFFSET_TABLE_"}
    arithmetic = {"expf", "log", "logf", "fmax", "sqrtf", "floorf"}
    assert needed <= {"memcpy", "memmove", "memset", "__stack_chk_fail"} | arithmetic | engines | of_the_compiler


def test_a_shared_library_exports_the_interface_alone(library):
    if which("nm") is None:
        pytest.skip("nm is not installed")
    command = ["nm", "--dynamic", "--defined-only", "--format=posix", library._name]
    lines = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()
    names = {line.split()[0] for line in lines} - {"_init", "_fini"}
    assert names == INTERFACE


def test_instruction_sets_differ_by_rounding(library, one, frames, monkeypatch):
    """The fastest one is the last."""
    outputs = []
    for isa in ("baseline", "avx2", "avx512", "any"):
        monkeypatch.setattr(library, "max_isa", ISAS[isa])
        runtime = CRuntime(library, SIZE[1], SIZE[0])
        assert runtime.isa <= ISAS[isa] or isa == "any"
        outputs.append(torch.cat([runtime(frame, index == 0) for index, frame in enumerate(frames)]))
    brightest = outputs[0].amax().item()
    for output in outputs[1:]:
        torch.testing.assert_close(output, outputs[0], rtol=0, atol=ISA_TOLERANCE * brightest)
    assert torch.equal(outputs[-1], outputs[-2])


@pytest.mark.slow
@pytest.mark.parametrize("flags", [["-O3"], ["-O1", "-std=gnu17", "-mfpmath=387"]], ids=["plain", "x87"])
def test_one_file_alone_serves_the_flags_of_the_compiler(one, frames, flags, tmp_path):
    """Also where floats are computed in higher precision, as on i386."""
    if subprocess.run([CC, *flags, "-E", "-x", "c", "/dev/null"], capture_output=True).returncode:
        pytest.skip(f"{CC} does not take {' '.join(flags)}")
    library = build(tmp_path / "libonespp.so", SOURCES[:1], flags)
    assert CRuntime(library, 8, 8).isa == ISAS["baseline"]
    compare(library, one, frames)


@pytest.mark.parametrize("size", [(1, 1), (2, 3), (13, 7), (40, 56), (3, 190), (41, 70), (197, 24), (9, 590)])
def test_it_computes_what_the_denoiser_does(limited, one, size):
    """With a moving camera, moving meshes, disocclusions and sky."""
    compare(limited, one, synthetic(4, size))


def test_resets_and_changes_of_size(limited, one):
    sequence = [*synthetic(3), *synthetic(2, first=9), *synthetic(2, (24, 64), first=9), *synthetic(2, first=11)]
    compare(limited, one, sequence, resets=(0, 3))


def in_parts(frame: Frame, count: int) -> Frame:
    """The frame with parts that add up to its light, of which the first has either sign."""
    light = frame.direct + frame.indirect
    shares = torch.rand(count, *light.shape, generator=torch.Generator().manual_seed(count)) - 0.3
    shares[-1] = 1 - shares[:-1].sum(dim=0)
    return replace(frame, parts=torch.cat([*(shares * light)], dim=1))


@pytest.mark.parametrize("size", [(1, 1), (13, 7), (41, 70), (197, 24), (5, 333)])
def test_parts_of_the_light(limited, one, size):
    frames = [in_parts(frame, count) for frame, count in zip(synthetic(5, size), (2, 2, 3, 3, 1), strict=True)]
    compare(limited, one, frames)
    compare(limited, one, [replace(frame, masks=1) for frame in frames])
    runtime = CRuntime(limited, size[1], size[0], parts=3)
    for frame in frames:
        whole = runtime(frame, reset=False) - frame.emission
        summed = runtime.parts.unflatten(1, (-1, 3)).sum(dim=1)
        torch.testing.assert_close(summed, whole, rtol=1e-5, atol=1e-5 * float(whole.abs().amax()))


def test_the_whole_is_the_same_with_and_without_parts(limited, frames):
    runtimes = [CRuntime(limited, SIZE[1], SIZE[0], parts=count) for count in (0, 2)]
    for frame in frames:
        assert torch.equal(runtimes[0](frame, False), runtimes[1](in_parts(frame, 2), False))


def test_parts_of_light_of_any_size_are_finite(limited, one, frames):
    extreme = []
    for index, frame in enumerate(frames):
        parts = in_parts(disturbed(frame, ["direct"], (1e34, -1e30, 0.0), index), 2).parts
        parts[..., ::3, ::5] = torch.tensor([1e35, -1e35, float("nan"), float("inf")])[index]
        extreme.append(replace(frame, parts=parts))
    compare(limited, one, extreme)


def test_frames_count_by_their_samples(limited, one, frames):
    counts = (1.0, 16.0, 0.25, 4096.0)
    compare(limited, one, [replace(f, spp=torch.full((1, 1, 1, 1), n)) for f, n in zip(frames, counts, strict=True)])


def test_frames_without_any_surface_or_light(limited, one, frames):
    light = ("direct", "indirect")
    empty = {name: torch.zeros_like(frames[1].channel(name)) for name in ("depth", "mesh_id", "normal", *light)}
    dark = {name: empty[name] for name in light}
    compare(limited, one, [frames[0], frames[1].with_channels(empty), frames[2].with_channels(dark), frames[3]])


def disturbed(frame: Frame, names: Sequence[str], values: Sequence[float], seed: int) -> Frame:
    """The frame with some of the `values` in a tenth of the named channels' numbers."""
    generator = torch.Generator().manual_seed(seed)
    channels = {}
    for name in names:
        channel = frame.channel(name).clone()
        hit = torch.rand(channel.shape, generator=generator) < 0.1
        channel[hit] = torch.tensor(values)[torch.randint(len(values), (int(hit.sum()),), generator=generator)]
        channels[name] = channel
    return frame.with_channels(channels)


@pytest.mark.parametrize("name", ["direct", "indirect", "emission", "albedo", "normal", "depth", "roughness", "motion"])
def test_numbers_that_are_none_count_as_0(limited, one, frames, name):
    values = (torch.nan, torch.inf, -torch.inf)
    compare(limited, one, [disturbed(frame, [name], values, index) for index, frame in enumerate(frames)])


def test_motion_may_lead_anywhere(limited, one, frames):
    values = (1e30, -1e30, 1e5, -70.25, 0.0)
    compare(limited, one, [disturbed(frame, ["motion"], values, index) for index, frame in enumerate(frames)])


def test_light_may_be_of_any_size(limited, one, frames):
    for scale in (1e-12, 1e12):
        bright = [f.with_channels({name: scale * f.channel(name) for name in ("direct", "indirect")}) for f in frames]
        compare(limited, one, bright)


@pytest.mark.parametrize("name", BOUNDED)
def test_surfaces_count_as_at_most_100(limited, one, frames, name):
    values = (1e35, -1e35, 3e38, 101.0)
    compare(limited, one, [disturbed(frame, [name], values, index) for index, frame in enumerate(frames)])


def test_meshes_without_a_pose_stand_still(limited, one):
    """As do those whose number is negative."""
    generator = torch.Generator().manual_seed(1)
    ids = torch.randint(1, 3 * MESHES, (1, 1, *SIZE), generator=generator).float()
    light = [torch.rand(1, 3, *SIZE, generator=generator) for _ in range(4)]
    sequence = chain([flat_frame(*SIZE, (0.5, 0.25), mesh_id=ids, irradiance=each) for each in light])
    compare(limited, one, sequence)
    runtime = CRuntime(limited, SIZE[1], SIZE[0])
    for index, frame in enumerate(sequence):
        output = runtime(disturbed(frame, ["mesh_id"], (-1.0, -(2.0**31), 2.0**31 - 128), index), index == 0)
        assert output.isfinite().all()


@pytest.mark.parametrize("size", [SIZE, (70, 300)])
def test_meshes_that_look_alike_are_told_apart(limited, one, size):
    """By their numbers alone, also where float32 could not tell these apart."""
    generator = torch.Generator().manual_seed(2)
    light = [torch.rand(1, 3, *size, generator=generator) ** 4 for _ in range(3)]
    rows, columns = (torch.arange(side) // 5 for side in size)
    ids = (1 + (rows[:, None] + columns) % 2)[None, None]  # a chessboard
    sequence = chain([flat_frame(*size, mesh_id=ids, irradiance=each) for each in light])
    compare(limited, one, sequence)
    small, large = (CRuntime(limited, size[1], size[0]) for _ in range(2))
    for index, frame in enumerate(sequence):
        renamed = frame.with_channels({"mesh_id": 2.0**30 + frame.mesh_id.double()})
        assert torch.equal(large(renamed, index == 0), small(frame, index == 0))


def test_optional_images(limited, one, frames):
    """Their values by default, and one mesh for all surfaces."""
    ones, zeros = torch.ones_like(frames[0].depth), torch.zeros_like(frames[0].direct)
    runtime, state = CRuntime(limited, SIZE[1], SIZE[0]), None
    for index, frame in enumerate(frames):
        ids = (frame.depth > 0).float()
        plain = {"indirect": zeros, "emission": zeros, "roughness": ones, "mesh_id": ids}
        with torch.no_grad():
            expected, state = one(frame.with_channels(plain), state)
        actual = runtime(frame, index == 0, without=list(plain))
        torch.testing.assert_close(actual, expected, rtol=0, atol=TOLERANCE * expected.amax().item())


def test_images_may_be_interleaved(limited, frames):
    planar, interleaved = (CRuntime(limited, SIZE[1], SIZE[0]) for _ in range(2))
    for index, frame in enumerate(frames):
        assert torch.equal(planar(frame, index == 0), interleaved(frame, index == 0, interleaved=True))


def test_threads_change_nothing(limited):
    """Bit for bit, with more tasks than threads, and than rows."""
    sequence = synthetic(3, (70, 33))

    def run(tasks: int, threads: int) -> Tensor:
        with ThreadPoolExecutor(threads) as pool:

            def parallel_for(_: int, count: int, task: Task, argument: int) -> None:
                list(pool.map(lambda index: task(argument, index), reversed(range(count))))

            runtime = CRuntime(limited, 33, 70, tasks=tasks, parallel_for=parallel_for)
            return torch.cat([runtime(frame, index == 0) for index, frame in enumerate(sequence)])

    alone = run(1, 1)
    for tasks, threads in ((2, 2), (7, 3), (100, 4)):
        assert torch.equal(run(tasks, threads), alone)


def aligned(size: int) -> np.ndarray:
    """Memory that begins where histories may."""
    memory = np.full(size + 64, 0xFF, np.uint8)
    return memory[-memory.ctypes.data % 64 :][:size]


def test_histories_are_values(limited):
    """Frames that go on from an earlier history, or a copy of it, equal those of a denoiser that played them all."""
    size, frames = (41, 70), synthetic(4, (41, 70))
    played, other = (CRuntime(limited, size[1], size[0], meshes=count) for count in (64, 100))
    expected = [played(frame, index == 0) for index, frame in enumerate(frames)]
    count = max(limited.onespp_history_size(ctypes.byref(runtime.config)) for runtime in (played, other))
    histories: list[np.ndarray] = []
    for index, frame in enumerate(frames):
        histories.append(aligned(count))
        past = address(histories[index - 1]) if index else None
        assert torch.equal(other(frame, reset=False, histories=(past, address(histories[index]))), expected[index])
    again, copy = aligned(count), aligned(count)
    copy[:] = histories[1]
    assert torch.equal(played(frames[2], reset=False, histories=(address(copy), address(again))), expected[2])
    assert torch.equal(other(frames[3], reset=False, histories=(address(again), address(again))), expected[3])
    assert torch.equal(played(frames[3], reset=False, histories=(address(histories[2]), address(copy))), expected[3])


def test_a_history_is_read_as_images(limited, one, frames):
    runtime, state = CRuntime(limited, SIZE[1], SIZE[0]), None
    memory = aligned(limited.onespp_history_size(ctypes.byref(runtime.config)))
    for index, frame in enumerate(frames):
        runtime(frame, reset=False, histories=(address(memory) if index else None, address(memory)))
        with torch.no_grad():
            _, state = one(frame, state)
    images = np.full((sum(HISTORY), *SIZE), np.nan, np.float32)
    limited.onespp_read_history(runtime.denoiser, address(memory), ctypes.byref(strided(images, interleaved=False)))
    expected = torch.cat([state.output, state.accumulated, state.length, state.latent], dim=1)[0]
    torch.testing.assert_close(torch.from_numpy(images), expected, rtol=1e-3, atol=1e-3)


def test_histories_begin_at_multiples_of_64_bytes(limited, frames):
    runtime = CRuntime(limited, SIZE[1], SIZE[0])
    memory = aligned(limited.onespp_history_size(ctypes.byref(runtime.config)) + 64)
    for past, after in ((None, None), (None, address(memory[4:])), (address(memory[4:]), address(memory))):
        arguments = [runtime.denoiser, past, after, ctypes.byref(CFrame()), ctypes.byref(Image())]
        assert limited.onespp_denoise_from(*arguments) == 3


def test_other_weights_than_those_compiled_in(limited, one, frames):
    """Handed over as floats: those of half precision give the same bits."""
    runtime = CRuntime(limited, SIZE[1], SIZE[0])
    weights = in_order({name: tensor.numpy() for name, tensor in one.network.state_dict().items()})
    arguments = [ctypes.byref(runtime.config), address(runtime.memory), ctypes.c_size_t(runtime.size)]
    expected = [runtime(frame, index == 0) for index, frame in enumerate(frames)]
    made = ctypes.byref(runtime.denoiser)
    assert limited.onespp_create_with(*arguments, address(weights), ctypes.c_size_t(weights.size), made) == 0
    for index, frame in enumerate(frames):
        assert torch.equal(runtime(frame, index == 0), expected[index])
    assert limited.onespp_create_with(*arguments, address(weights), ctypes.c_size_t(weights.size - 1), made) == 2


def test_errors_leave_everything_as_it_was(limited, frames):
    runtime, other = (CRuntime(limited, SIZE[1], SIZE[0]) for _ in range(2))
    for index, frame in enumerate(frames):
        output = np.full((3, *SIZE), 7, np.float32)
        for changes in (
            {"width": 0},
            {"width": SIZE[1] + 1},
            {"samples": np.nan},
            {"samples": 0.0},
            {"meshes": 65},
            {"masks": 1},
            {},
        ):
            given = CFrame(**({"width": 8, "height": 8, "samples": 1.0} | changes))
            error = runtime.call(given, Image(address(output), 0, 0, 0))
            assert limited.onespp_message(error).startswith(b"a size, a number")
        assert (output == 7).all()
        assert torch.equal(runtime(frame, index == 0), other(frame, index == 0))


def test_bad_configurations(limited):
    fine = {"abi": ABI, "max_width": 8, "max_height": 8, "max_meshes": 0, "tasks": 1, "max_isa": limited.max_isa}
    memory = np.zeros(limited.onespp_size(ctypes.byref(Config(**fine))), np.uint8)
    denoiser = ctypes.c_void_p()

    def create(size: int, **changes: int) -> int:
        arguments = ctypes.byref(Config(**(fine | changes))), address(memory), ctypes.c_size_t(size)
        return limited.onespp_create(*arguments, ctypes.byref(denoiser))

    assert create(memory.size) == 0
    assert create(memory.size, abi=ABI + 1) == 1
    bad = ({"max_width": 0}, {"max_height": 1 << 20}, {"max_meshes": -1}, {"tasks": 0}, {"max_isa": -1}, {"max_isa": 4})
    assert [create(memory.size, **changes) for changes in bad] == [2] * len(bad)
    assert create(memory.size - 1) == 3


def test_frames_of_4k_take_at_most_2_2_gb(limited):
    """So that a process with all inputs takes at most 3 GB."""
    config = Config(ABI, 3840, 2160, 64, 4)
    assert 0 < limited.onespp_size(ctypes.byref(config)) <= 2.2e9


def check_example(command: list[str], one: One, frames: list[Frame], folder: Path) -> None:
    """Play the frames, with a cut at the end, through the example."""
    sequence = [*frames, *synthetic(1, first=20)]
    write_raw(sequence, folder / "frames.raw")
    subprocess.run([*command, "frames.raw", "out.raw", "3"], cwd=folder, check=True, capture_output=True)
    outputs = torch.from_numpy(np.fromfile(folder / "out.raw", np.float32).reshape(len(sequence), 1, 3, *SIZE))
    state = None
    for frame, output in zip(sequence, outputs, strict=True):
        with torch.no_grad():
            expected, state = one(frame, state)
        torch.testing.assert_close(output, expected, rtol=0, atol=TOLERANCE * expected.amax().item())


def test_a_sequence_that_cannot_be_written(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["raw.py", "8x8", "1", str(tmp_path / "missing" / "frames.raw")])
    with pytest.raises(SystemExit, match=r"missing/.*frames\.raw.*: No such file .* choose another file"):
        runpy.run_path(str(FOLDER / "raw.py"), run_name="__main__")


def test_the_example_denoises_a_raw_sequence(one, frames, tmp_path, objects):
    command = [CC, *STRICT, *OPTIMISED, "-pthread", str(FOLDER / "example.c"), *objects.values()]
    subprocess.run([*command, "-o", str(tmp_path / "example"), "-lm"], check=True)
    check_example([str(tmp_path / "example")], one, frames, tmp_path)
    whole, earlier = ((tmp_path / name).read_bytes() for name in ("frames.raw", "out.raw"))

    def complaint(source: str, content: bytes) -> str:
        (tmp_path / source).write_bytes(content)
        command = [str(tmp_path / "example"), source, "out.raw"]
        run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
        assert run.returncode == 1
        return run.stderr

    assert "there is no whole frame" in complaint("damaged.raw", b"half a header")
    assert (tmp_path / "out.raw").read_bytes() == earlier
    for damaged in (whole[:-1000], whole + b"half a header"):
        assert "the sequence is damaged" in complaint("damaged.raw", damaged)
    assert "the output would overwrite the sequence" in complaint("out.raw", whole)
    assert (tmp_path / "out.raw").read_bytes() == whole


# --- Long proofs ------------------------------------------------------------------------------------------------------


def shaky(index: int) -> Frame:
    """Light on a wall before which the camera slides back and forth, by fractions of a pixel."""
    generator = torch.Generator().manual_seed(index)
    light = 4 * torch.rand(1, 3, 48, 72, generator=generator) ** 6
    ids = torch.arange(72).div(9, rounding_mode="floor").add(1).expand(1, 1, 48, 72)
    motion = [(0.5, 0.25), (-0.7, 0.1), (1.0, 0.0), (-1.3, -0.4)][index % 4]
    return flat_frame(48, 72, motion, mesh_id=ids, irradiance=light)


CLIPS = {
    "synthetic": lambda: synthetic(50, (96, 128)),
    "4 spp": lambda: [
        replace(frame, spp=torch.full((1, 1, 1, 1), 4.0)) for frame in synthetic(50, (80, 176), first=100)
    ],
    "wall": lambda: chain([shaky(index) for index in range(50)]),
    "cuts and sizes": lambda: [synthetic_frame(index, 64 + 16 * (index // 20 % 2), 90) for index in range(50)],
}


@pytest.mark.slow
@pytest.mark.parametrize("clip", CLIPS)
def test_fifty_frames(limited, one, clip):
    worst = compare(limited, one, CLIPS[clip](), resets=(0, 33) if clip == "cuts and sizes" else (0,))
    print(f"{clip}: {worst:.1e}")


@pytest.mark.slow
def test_rendered_clips(limited, one, tiny):
    for clip in Dataset(tiny).clips("test"):
        sequence = [read_frame(clip, index, one.reads, in_layers=False) for index in range(clip.frames)]
        compare(limited, one, sequence)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gcc", "clang"])
def test_sanitizers_report_nothing(name, tmp_path):
    """On random frames, with all extremes of numbers and sizes."""
    if which(name) is None:
        pytest.skip(f"{name} is not installed")
    flags = ("-O2", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", STRIPS, "-DONESPP_DISPATCH")
    sources = [str(FOLDER / "fuzz.c"), *SOURCES]
    subprocess.run([name, *STRICT, *flags, *sources, "-o", str(tmp_path / "fuzz"), "-lm"], check=True)
    subprocess.run([str(tmp_path / "fuzz"), "60"], check=True)


@pytest.mark.slow
def test_it_runs_on_aarch64(one, frames, tmp_path):
    """The example, emulated."""
    cross, emulator = which("aarch64-linux-gnu-gcc"), which("qemu-aarch64")
    if cross is None or emulator is None:
        pytest.skip("aarch64-linux-gnu-gcc or qemu-aarch64 is not installed")
    flags = (*STRICT, *OPTIMISED, "-static", "-pthread")
    sources = [str(FOLDER / "example.c"), *SOURCES]
    subprocess.run([cross, *flags, *sources, "-o", str(tmp_path / "example"), "-lm"], check=True)
    check_example([emulator, str(tmp_path / "example")], one, frames, tmp_path)


PROGRAM = """
#include <onespp.h>
int main(void) { return onespp_abi() != ONESPP_ABI; }
"""
PROJECT = """
cmake_minimum_required(VERSION 3.16)
project(program C)
if(SOURCE)
  add_subdirectory(${SOURCE} onespp)
else()
  find_package(onespp ${ABI} REQUIRED)
endif()
add_executable(program program.c)
target_link_libraries(program onespp::onespp)
"""


def cmake(*arguments: object, succeeds: bool = True) -> None:
    if which("cmake") is None:
        pytest.skip("cmake is not installed")
    assert (subprocess.run(["cmake", *map(str, arguments)]).returncode == 0) == succeeds


@pytest.mark.slow
def test_cmake_builds_it_for_other_projects(tmp_path):
    """Also where these join files to compile them; of another ABI than they ask for it is not taken."""
    build, installed, project = (tmp_path / name for name in ("build", "installed", "project"))
    cmake("-S", FOLDER, "-B", build, "-DBUILD_SHARED_LIBS=ON", "-DCMAKE_UNITY_BUILD=ON")
    cmake("--build", build)
    cmake("--install", build, "--prefix", installed)
    project.mkdir()
    (project / "program.c").write_text(PROGRAM)
    (project / "CMakeLists.txt").write_text(PROJECT)
    configure = ("-S", project, f"-DCMAKE_PREFIX_PATH={installed}")
    cmake(*configure, "-B", build / "other", f"-DABI={ABI + 1}", succeeds=False)
    cmake(*configure, "-B", build / "found", f"-DABI={ABI}")
    cmake("--build", build / "found")
    subprocess.run([build / "found" / "program"], check=True)
    cmake(*configure, "-B", build / "added", f"-DSOURCE={FOLDER}")


@pytest.mark.slow
def test_cmake_installs_a_dll_for_windows(tmp_path):
    compiler = which("x86_64-w64-mingw32-gcc")
    if compiler is None:
        pytest.skip("x86_64-w64-mingw32-gcc is not installed")
    windows = ("-DCMAKE_SYSTEM_NAME=Windows", f"-DCMAKE_C_COMPILER={compiler}", "-DBUILD_SHARED_LIBS=ON")
    cmake("-S", FOLDER, "-B", tmp_path / "build", *windows)
    cmake("--build", tmp_path / "build")
    cmake("--install", tmp_path / "build", "--prefix", tmp_path / "installed")
    assert [path.name for path in (tmp_path / "installed" / "bin").iterdir()] == ["libonespp.dll"]


@pytest.mark.slow
def test_make_builds_it(tmp_path):
    if which("make") is None:
        pytest.skip("make is not installed")
    copy = Path(copytree(FOLDER, tmp_path / "runtime"))
    subprocess.run(["make", "-C", str(copy)], check=True)
    assert (copy / "libonespp.a").exists() and (copy / "example").exists()
