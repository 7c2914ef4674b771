"""Every kind of damage is detected and named."""

import shutil
from pathlib import Path

import numpy as np

from datasets.verify import find_problems, problems_of_clip


def flip_byte(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def test_an_undamaged_data_set_has_no_problems(tiny):
    assert find_problems(tiny) == []


def test_every_kind_of_damage_is_named(tiny_copy):
    clip = tiny_copy / "train" / "cornell_box" / "000"
    flip_byte(clip / "depth.npy")
    (clip / "normal.npy").write_bytes((clip / "normal.npy").read_bytes()[:-100])
    (clip / "albedo.npy").unlink()
    np.save(clip / "mesh_id.npy", np.zeros((2, 2), np.uint16))
    (tiny_copy / "val" / "cornell_box" / "000" / "clip.json").write_text("{")
    shutil.rmtree(tiny_copy / "test" / "cornell_box" / "000")
    problems = find_problems(tiny_copy)
    for damaged in ("depth.npy", "normal.npy", "albedo.npy", "mesh_id.npy", "clip.json", "test/cornell_box/000"):
        assert any(damaged in problem for problem in problems)
    assert len(problems) == 6


def test_flipped_bits_in_a_header_are_found(tiny_copy):
    """Numpy reads the header of an .npy file as Python."""
    path = tiny_copy / "test" / "cornell_box" / "000"
    content = (path / "depth.npy").read_bytes()
    rng = np.random.default_rng(0)
    for bit in rng.integers(0, 128 * 8, 60):
        data = bytearray(content)
        data[bit // 8] ^= 1 << (bit % 8)
        (path / "depth.npy").write_bytes(data)
        assert any("depth.npy" in problem for problem in problems_of_clip(path))
