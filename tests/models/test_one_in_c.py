"""`one` in C is `one` in PyTorch with kernels: its outputs, its state, and what it leaves to PyTorch."""

import copy
import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from datasets.frame import Frame
from eval.bench.synthetic_frames import synthetic_frame
from models import compiled
from models.compiled import one_in_c
from models.compiled.one_in_c import StateInC
from models.denoiser import Denoiser
from models.networks.one import One, OneState
from models.spec import DenoiserSpec, fastest_precision
from models.wrappers.wrapper import unwrapped
from tests.helpers.c_runtime import CC
from tests.helpers.frames import play, prepared, run
from tests.models.test_glass_layers import glass_frame
from tests.models.test_parts import in_parts

SIZE = (41, 70)
TOLERANCE = 1e-5  # of the brightest pixel

pytestmark = pytest.mark.skipif(not CC, reason="there is no C compiler")


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    """A moving camera, moving meshes, disocclusions and sky."""
    return [synthetic_frame(index, *SIZE) for index in range(5)]


def in_c(signal=None) -> Denoiser:
    """Random weights that no half precision holds."""
    denoiser = prepared("one", signal)
    denoiser.use_c()
    return denoiser


def assert_close(actual: Tensor, expected: Tensor) -> None:
    torch.testing.assert_close(actual, expected, rtol=0, atol=TOLERANCE * float(expected.abs().max()))


def check_equal(frames: list[Frame], signal=None) -> None:
    for actual, expected in zip(run(in_c(signal), frames), run(prepared("one", signal), frames), strict=True):
        assert_close(actual, expected)


@pytest.mark.parametrize("signal", ["total", "indirect"])
def test_it_computes_what_pytorch_does(frames, signal):
    """Also after a cut, and when the size changes."""
    others = [synthetic_frame(index, 24, 33) for index in (9, 10)]
    check_equal([*frames, *others, *frames[:2]], signal)


def test_glass_in_two_layers():
    glass = [replace(frame, previous=frame.now) for frame in (glass_frame(seed, noise=0.5) for seed in range(4))]
    _, state = play(in_c(), glass)
    assert isinstance(state.main, StateInC) and isinstance(state.second, StateInC)
    check_equal(glass)


def test_parts_of_the_light_and_masks(frames):
    given = [replace(in_parts(frame, seed), masks=1) for seed, frame in enumerate(frames)]
    ours, theirs = in_c(), prepared("one")
    state = expected = None
    with torch.inference_mode():
        for frame in given:
            before = frame.parts.clone()
            _, state = ours(frame, state)
            _, expected = theirs(frame, expected)
            assert torch.equal(frame.parts, before)
            assert_close(ours.parts(frame, state), theirs.parts(frame, expected))


def test_its_state_is_a_value(frames):
    """Which frames can follow more than once, whatever the denoiser has done in the meantime."""
    denoiser = in_c()
    outputs, states = [], [None]
    with torch.inference_mode():
        for frame in frames:
            output, state = denoiser(frame, states[-1])
            outputs.append(output)
            states.append(state)
        for index in (3, 1, 4):
            again, _ = denoiser(frames[index], states[index])
            assert torch.equal(again, outputs[index])
    assert not torch.equal(outputs[0], outputs[1])


def test_pictures_of_its_state(frames):
    _, state = play(in_c(), frames)
    _, expected = play(prepared("one"), frames)
    assert isinstance(state, StateInC) and isinstance(expected, OneState)
    for name, picture in state.pictures().items():
        assert_close(picture, expected.pictures()[name])


def test_copies_and_threads_have_working_memory_in_turn(frames):
    denoiser = in_c()
    expected = run(denoiser, frames)[-1]
    for copied in (copy.deepcopy(denoiser), pickle.loads(pickle.dumps(denoiser))):
        del denoiser
        assert torch.equal(run(copied, frames)[-1], expected)
        denoiser = copied
    with ThreadPoolExecutor(3) as pool:
        for outputs in pool.map(lambda _: run(denoiser, frames), range(3)):
            assert torch.equal(outputs[-1], expected)


def test_threads_change_no_bit(frames):
    before = torch.get_num_threads()
    try:
        outputs = []
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            outputs.append(run(in_c(), frames)[-1])
    finally:
        torch.set_num_threads(before)
    assert torch.equal(outputs[0], outputs[1]) and torch.equal(outputs[0], outputs[2])


def test_what_it_leaves_to_pytorch(frames):
    """Gradients, batches, crops of training, and benches without kernels."""
    denoiser = in_c()

    def state_of(frame: Frame) -> object:
        return type(denoiser(frame, None)[1])

    assert state_of(frames[0]) is StateInC
    light = frames[0].direct.clone().requires_grad_()
    assert state_of(frames[0].with_channels({"direct": light})) is OneState
    with torch.inference_mode():
        assert state_of(Frame.stack([frames[0], frames[1]])) is OneState
        assert state_of(replace(frames[0], colour_gain=torch.ones(1, 3, 1, 1))) is OneState
        with compiled.disabled():
            assert state_of(frames[0]) is OneState


def test_what_is_beyond_the_limits_of_c_runs_in_pytorch(frames):
    denoiser = in_c()
    many = replace(frames[0], parts=frames[0].direct.repeat(1, 17, 1, 1))
    wide = synthetic_frame(0, 1, 16385)
    for frame in (many, wide, replace(frames[0], spp=torch.full((1, 1, 1, 1), 1e-4))):
        output, state = denoiser(frame, None)
        assert isinstance(state, OneState) and output.isfinite().all()


def test_history_begins_anew_with_other_parts(frames):
    denoiser = in_c()
    _, state = denoiser(frames[0], None)
    after, _ = denoiser(in_parts(frames[1], 0), state)
    anew, _ = denoiser(in_parts(frames[1], 0), None)
    assert torch.equal(after, anew)


def test_it_runs_where_denoisers_are_built_to_run():
    spec = DenoiserSpec.named("one+js")
    assert fastest_precision("one+js") == "float32"
    inner = unwrapped(spec.build())
    assert isinstance(inner, One) and inner.in_c is not None
    for other in (replace(spec, compiled=False), replace(spec, precision="bfloat16")):
        assert unwrapped(other.build()).in_c is None


@pytest.mark.parametrize("compiler", [None, "false"])
def test_without_a_compiler_pytorch_computes_and_says_so(frames, monkeypatch, tmp_path, capsys, compiler):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(one_in_c.shutil, "which", lambda name: compiler)
    one_in_c.runtime.cache_clear()
    try:
        denoiser = in_c()
        assert not one_in_c.is_available() and denoiser.in_c is None
        assert DenoiserSpec.named("one").c_digest is None
        assert isinstance(play(denoiser, frames[:1])[1], OneState)
    finally:
        one_in_c.runtime.cache_clear()
    assert not [*tmp_path.glob("onespp/*")]
    assert "one: " in (text := capsys.readouterr().err) and "PyTorch" in text


def test_it_is_compiled_once_and_anew_when_sources_change(monkeypatch, tmp_path):
    made, digests = [], []

    def record(compiler, folder):
        folder.mkdir(parents=True)
        (folder / "library.py").write_text("")
        made.append(folder)

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(one_in_c, "compile_library", record)
    try:
        for flags in (one_in_c.FLAGS, one_in_c.FLAGS, ("-O1",)):
            monkeypatch.setattr(one_in_c, "FLAGS", flags)
            one_in_c.runtime.cache_clear()
            digests.append(DenoiserSpec.named("one").c_digest)
    finally:
        one_in_c.runtime.cache_clear()
    assert len(made) == 2
    assert digests[0] and digests[0] == digests[1] != digests[2]


def test_an_instruction_set_can_be_ruled_out(frames, monkeypatch):
    monkeypatch.setenv("ONEDNN_MAX_CPU_ISA", "AVX2")
    denoiser = in_c()
    run(denoiser, frames[:1])
    [handle] = denoiser.in_c.handles.values()
    assert handle.isa in ("avx2", "baseline")
