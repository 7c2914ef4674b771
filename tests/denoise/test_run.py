"""Whole sequences under other renderers' names, from files to files."""

import csv
import hashlib
import json
import math
import os
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import torch
from PIL import Image as Picture
from torch import Tensor

from command_line import main
from datasets.clip import Dataset
from datasets.exr import export_clip
from datasets.frame import Frame, read_frame
from denoise.exr_image import ExrImage
from denoise.frame_errors import ErrorTable
from denoise.job import Job
from denoise.parts import Parts
from denoise.run import SequenceDenoiser, denoise
from denoise.sequence import FrameFiles
from errors import BadInput
from eval.tradeoff.samples import with_samples
from models.registry import create
from models.spec import load
from models.weights import save_weights
from tests.denoise.conftest import as_foreign
from tests.helpers import foreign
from tests.helpers.frames import run
from tests.helpers.training import fresh_weights
from tests.models.test_glass_layers import glass_frame
from tests.test_cli import fails

TARGETS = ("ViewLayer.Combined.", "rgba.Beauty.", "Foo.", "")  # where denoised radiance is, before R, G and B


def denoised(folder: Path, out: Path, denoiser: str = "svgf", **options: object) -> list[Tensor]:
    """The images (1, 3, H, W) that a job makes of the files in a folder."""
    denoise(Job((str(folder / "*.exr"),), denoiser, out, **options))
    return images_in(out)


def images_in(out: Path, layer: str | None = None) -> list[Tensor]:
    """Denoised images (1, 3, H, W), or those of another layer, in order."""
    images = []
    for path in sorted(out.glob("*.exr")):
        planes = foreign.read(path)
        prefix = next(name for name in TARGETS if f"{name}R" in planes) if layer is None else layer
        images.append(torch.from_numpy(np.stack([planes[f"{prefix}{c}"] for c in "RGB"]).astype(np.float32))[None])
    return images


def same(a: Sequence[Tensor], b: Sequence[Tensor]) -> bool:
    return all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


def error(a: Sequence[Tensor], b: Sequence[Tensor]) -> float:
    """RMSE of two sequences as displayed."""
    pairs = zip(a, b, strict=True)
    return math.sqrt(np.mean([(x.clamp(0, 1) - y.clamp(0, 1)).square().mean().item() for x, y in pairs]))


def contents(folder: Path, pattern: str = "*") -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.glob(pattern)}


@pytest.mark.parametrize("name", ["svgf", "wskp6", "ntd", "asvgf"])
def test_our_own_clip_gives_the_same_from_exr(tiny, tmp_path, name, capsys):
    clip = next(clip for clip in Dataset(tiny).clips("test") if clip.scene == "cornell_box_moving")
    export_clip(clip.path, tmp_path / "exr")
    weights = fresh_weights(name, tmp_path / "w") if create(name).is_network else None
    images = denoised(tmp_path / "exr", tmp_path / "out", name, weights=weights, frame_range="0-2")
    denoiser = load(name, weights, signal="total")
    assert same(images, run(denoiser, (read_frame(clip, index, denoiser.reads) for index in range(3))))
    assert "onespp's own" in capsys.readouterr().out


def assert_as_expected(images: Sequence[Tensor], box: Sequence[Frame]) -> None:
    """The images are those of svgf on our own frames, up to the rounding of cameras."""
    expected = run(create("svgf"), map(as_foreign, box))
    assert error(images, expected) < 0.01 * error(expected, [torch.zeros_like(image) for image in expected])


def test_pbrt_names_give_what_the_frames_give(box, tmp_path, capsys):
    foreign.write_sequence(tmp_path / "in", box, foreign.pbrt)
    assert_as_expected(denoised(tmp_path / "in", tmp_path / "out"), box)
    printed = capsys.readouterr().out
    assert "cameras       from the positions" in printed and "motion        derived" in printed


def test_positions_in_camera_space_need_the_cameras_matrix(box, tmp_path, capsys):
    for index, frame in enumerate(box):
        to_camera = np.linalg.inv(foreign.view(frame).camera_to_world)
        layers = foreign.pbrt(frame)
        layers["P.XYZ"] = layers["P.XYZ"] @ to_camera[:3, :3].T + to_camera[:3, 3]
        layers["Ns.XYZ"] = layers["Ns.XYZ"] @ to_camera[:3, :3].T
        matrix = {"worldToCamera": np.ascontiguousarray(to_camera.T, np.float32)}
        foreign.write(tmp_path / "in" / f"{index}.exr", layers, matrix)
        foreign.write(tmp_path / "without" / f"{index}.exr", layers)
    assert_as_expected(denoised(tmp_path / "in", tmp_path / "out"), box)
    assert "moved to the world by worldToCamera" in capsys.readouterr().out
    denoised(tmp_path / "without", tmp_path / "alone")
    assert "none: no history" in capsys.readouterr().out


def test_blenders_names_keep_most_of_the_history(box, tmp_path, capsys):
    foreign.write_sequence(tmp_path / "in", box, foreign.blender)
    images = denoised(tmp_path / "in", tmp_path / "out", albedo="exact")
    printed = capsys.readouterr().out
    assert "ViewLayer.Noisy Image" in printed and "XY,+x,-y,pixels" in printed and "warp error" in printed
    denoiser = create("svgf")
    expected = run(denoiser, map(as_foreign, box))
    assert error(images, expected) < 0.4 * error([denoiser(as_foreign(frame), None)[0] for frame in box], expected)
    assert torch.allclose(images[0], expected[0], rtol=1e-4, atol=1e-5)  # where there is no history, nothing is lost


def test_the_sky_stays_as_it_is_and_only_the_image_changes(spheres, tmp_path):
    options = {"header": {"owner": "me", "worldToCamera": np.eye(4, dtype=np.float32)}, "dtype": np.float16}
    before = foreign.write_sequence(tmp_path / "in", spheres, foreign.blender, **options)
    denoised(tmp_path / "in", tmp_path / "out")
    for path, frame in zip(before, spheres, strict=True):
        old, new = foreign.read(path), foreign.read(tmp_path / "out" / path.name)
        header = foreign.header(tmp_path / "out" / path.name)
        assert old.keys() == new.keys() and header["owner"] == "me" and header["denoised"].startswith("onespp svgf ")
        np.testing.assert_array_equal(header["worldToCamera"], np.eye(4))
        assert all(new[name].dtype == np.float16 for name in new)
        replaced = {f"ViewLayer.Combined.{c}" for c in "RGB"}
        assert all((old[name].tobytes() == new[name].tobytes()) == (name not in replaced) for name in old)
        sky = frame.depth[0, 0].numpy() == 0
        for c in "RGB":
            np.testing.assert_array_equal(new[f"ViewLayer.Combined.{c}"][sky], old[f"ViewLayer.Noisy Image.{c}"][sky])


PLAIN = {"albedo.RGB": "albedo", "N.XYZ": "normal", "Z": "depth", "motion.XY": "motion"}
BEAUTY = {"RGB": "rgba.Beauty.RGB", "albedo.RGB": "DiffCol.RGB", "N.XYZ": "Denoising Normal.XYZ", "Z": "Depth.V"}
OPTIX = {"albedo.RGB": "VisibleDiffuse.RGB", "N.XYZ": "OptixNormals.XYZ", "Z": "depth.Z", "motion.XY": "mv.RG"}
FILES = {"alb": "albedo.RGB", "nrm": "N.XYZ", "depth": "Z", "mv": "motion.XY"}


def plain_layers(frame: Frame) -> foreign.Layers:
    return {"RGB": foreign.beauty(frame)} | {layer: foreign.image(frame, channel) for layer, channel in PLAIN.items()}


@pytest.mark.parametrize("names", [BEAUTY, OPTIX, None], ids=["beauty", "optix", "files"])
def test_names_and_files_make_no_difference(spheres, tmp_path, names):
    """The same passes, under other layers' names or in files of their own, give the same."""
    foreign.write_sequence(tmp_path / "plain", spheres, plain_layers)
    passes = {}
    if names:
        foreign.write_sequence(
            tmp_path / "in", spheres, lambda f: {names.get(name, name): x for name, x in plain_layers(f).items()}
        )
    else:
        foreign.write_sequence(tmp_path / "in", spheres, lambda f: {"RGB": foreign.beauty(f)})
        for flag, layer in FILES.items():
            letters = "RGB"[: spheres[0].channels[PLAIN[layer]].shape[1]]
            foreign.write_sequence(tmp_path / flag, spheres, lambda f, _l=layer, _c=letters: {_c: plain_layers(f)[_l]})
            passes[flag] = (str(tmp_path / flag / "*.exr"),)
    expected = denoised(tmp_path / "plain", tmp_path / "expected")
    assert same(denoised(tmp_path / "in", tmp_path / "out", **passes), expected)


def test_positions_and_ids_in_files_of_their_own(spheres, tmp_path):
    """They give the history of one file with all layers; and ids separate what geometry does not."""

    def with_ids(frame: Frame) -> foreign.Layers:
        halves = np.arange(frame.size[1])[None, :, None] < frame.size[1] // 2
        return foreign.pbrt(frame) | {"id.Y": np.broadcast_to(np.where(halves, 3.0, 70000.0), (*frame.size, 1))}

    foreign.write_sequence(tmp_path / "plain", spheres, foreign.pbrt)
    foreign.write_sequence(tmp_path / "together", spheres, with_ids)
    foreign.write_sequence(tmp_path / "colour", spheres, lambda f: {"RGB": foreign.beauty(f)})
    passes = {}
    for flag, layer in {"alb": "Albedo.RGB", "nrm": "N.XYZ", "pos": "P.XYZ", "ids": "id.Y"}.items():
        letters = layer.rpartition(".")[2]
        foreign.write_sequence(tmp_path / flag, spheres, lambda f, _l=layer, _c=letters: {_c: with_ids(f)[_l]})
        passes[flag] = (str(tmp_path / flag / "*.exr"),)
    together = denoised(tmp_path / "together", tmp_path / "expected")
    assert same(denoised(tmp_path / "colour", tmp_path / "out", **passes), together)
    assert not same(denoised(tmp_path / "plain", tmp_path / "other"), together)


def test_layers_of_unknown_names_are_named_by_the_user(spheres, tmp_path):
    foreign.write_sequence(
        tmp_path / "in", spheres, lambda f: {"Foo.RGB": foreign.beauty(f), "Bar.RGB": foreign.image(f, "albedo")}
    )
    complaint = r"no layer with a name of radiance; it has Bar\.BGR, Foo\.BGR: name it by --layers"
    with pytest.raises(BadInput, match=complaint):
        denoised(tmp_path / "in", tmp_path / "out")
    assert not (tmp_path / "out").exists()
    images = denoised(tmp_path / "in", tmp_path / "out", "noisy", layers=["colour=Foo", "albedo=Bar"])
    assert all(map(torch.allclose, images, [frame.radiance("total") for frame in spheres]))


def test_colour_alone_is_denoised_frame_by_frame(spheres, tmp_path, capsys):
    foreign.write_sequence(tmp_path / "in", spheres, lambda f: {"RGB": foreign.beauty(f)})
    images = denoised(tmp_path / "in", tmp_path / "out")
    printed = capsys.readouterr().out
    missing = ("no history", "radiance is filtered", "as if all faced the viewer", "1 for every surface")
    assert all(f"none: {words}" in printed for words in missing)
    assert torch.equal(denoised(tmp_path / "in", tmp_path / "one", frame_range="3")[0], images[2])
    noise = [image.diff(dim=-1).abs().mean() for image in (images[0], spheres[0].radiance("total"))]
    assert noise[0] < noise[1] / 2


def test_multi_part_files(spheres, tmp_path):
    normal = foreign.image(spheres[0], "normal")
    layers = {"rgba": {"RGB": foreign.beauty(spheres[0])}, "N": {"XYZ": normal}}
    parts = [
        OpenEXR.Part({**foreign.HEADER, "owner": name}, foreign.planes(each), name) for name, each in layers.items()
    ]
    # What is not used may be cropped.
    display = {"displayWindow": parts[0].header["displayWindow"]}
    parts.append(OpenEXR.Part({**foreign.HEADER, **display}, {"Z": np.zeros((3, 5), np.float32)}, "crypto"))
    with OpenEXR.File(parts) as file:
        file.write(str(tmp_path / "1.exr"))
    denoise(Job((str(tmp_path / "1.exr"),), "svgf", tmp_path / "out"))
    with OpenEXR.File(str(tmp_path / "out" / "1.exr"), separate_channels=True) as file:
        assert [part.name() for part in file.parts] == ["rgba", "N", "crypto"] and file.parts[1].header["owner"] == "N"
        np.testing.assert_array_equal(file.parts[1].channels["Z"].pixels, normal[..., 2])
        assert np.abs(file.parts[0].channels["R"].pixels - foreign.beauty(spheres[0])[..., 0]).max() > 0.1


def test_bad_pixels_are_counted_and_stay_where_they_are(spheres, tmp_path, capsys):
    def broken(frame: Frame) -> foreign.Layers:
        layers = foreign.blender(frame)
        layers["ViewLayer.Noisy Image.RGBA"][30, 20, 1] = np.nan
        layers["ViewLayer.Denoising Albedo.RGB"][31, 21] = np.inf
        layers["ViewLayer.Vector.XYZW"][32, 22] = np.nan
        return layers

    foreign.write_sequence(tmp_path / "in", spheres, broken)
    images = denoised(tmp_path / "in", tmp_path / "out")
    assert "12 pixels were not finite" in capsys.readouterr().out
    assert all(torch.isfinite(image).all() for image in images)


@pytest.mark.parametrize(("stored_as", "dtype", "value"), [(None, np.float32, 3e5), ("half", np.float16, 65504)])
def test_radiance_is_not_clamped_and_precision_is_the_inputs_or_stated(tmp_path, stored_as, dtype, value):
    foreign.write(tmp_path / "in" / "1.exr", {"RGB": np.full((4, 4, 3), 3e5), "Z": np.ones((4, 4, 1))})
    denoised(tmp_path / "in", tmp_path / "out", "noisy", stored_as=stored_as)
    plane = foreign.read(tmp_path / "out" / "1.exr")["R"]
    assert plane.dtype == dtype and (plane == value).all()


def test_the_command_takes_shipped_weights_or_a_budgets_or_a_file(spheres, tmp_path, shipped):
    foreign.write_sequence(tmp_path / "in", spheres, foreign.blender)
    ours = fresh_weights("wskp3", shipped / "wskp3.safetensors")
    trained = tmp_path / "runs" / "train" / "wskp3-tiny" / "weights.safetensors"
    trained.parent.mkdir(parents=True)
    network = create("wskp3")
    network.load_state_dict({key: 2 * tensor for key, tensor in network.state_dict().items()})
    save_weights(network, "wskp3", {}, trained)
    call = ["denoise", str(tmp_path / "in" / "*.exr"), "--frames", "1-2", "--runs", str(tmp_path / "runs")]
    calls = {"ours": ["wskp3"], "trained": ["wskp3@tiny"], "file": ["wskp3", "-w", str(trained)]}
    for out, words in calls.items():
        main([*call, "--out", str(tmp_path / out), "--denoiser", *words])
        digest = json.loads((tmp_path / out / "denoise.json").read_text())["weights"]
        assert digest == hashlib.sha256((ours if out == "ours" else trained).read_bytes()).hexdigest()
    a, b, c = (images_in(tmp_path / out)[-1] for out in calls)
    assert torch.equal(b, c) and not torch.equal(a, b)


@pytest.mark.parametrize("name", ["svgf", "noisy"])
def test_an_interrupted_run_resumes_to_the_same(spheres, tmp_path, name):
    foreign.write_sequence(tmp_path / "in", [*spheres, *spheres[::-1]], foreign.blender)
    options = {"denoiser": name, "reset_at": [5], "png": True}
    for out in ("whole", "again"):
        denoised(tmp_path / "in", tmp_path / out, **options)
    for lost in ("0003.exr", "0007.exr", "0008.png"):
        (tmp_path / "again" / lost).unlink()
    kept = (tmp_path / "again" / "0005.exr").stat().st_mtime_ns
    denoised(tmp_path / "in", tmp_path / "again", **options)
    assert contents(tmp_path / "whole") == contents(tmp_path / "again")
    assert (tmp_path / "again" / "0005.exr").stat().st_mtime_ns == kept


def test_a_frame_rendered_again_is_denoised_again_with_all_that_depend_on_it(spheres, tmp_path, capsys):
    paths = foreign.write_sequence(tmp_path / "in", spheres, foreign.blender)
    denoised(tmp_path / "in", tmp_path / "out")
    later = (tmp_path / "out" / paths[2].name).stat().st_mtime + 10
    os.utime(paths[2], (later, later))
    capsys.readouterr()
    denoised(tmp_path / "in", tmp_path / "out")
    assert "2 of them new" in capsys.readouterr().out


@pytest.mark.parametrize("ends_by", ["interruption", "--frames"])
def test_history_of_a_frame_rendered_again_stays_in_no_later_frame(spheres, tmp_path, monkeypatch, ends_by):
    """Where a run ended before them, and where the new file is older than what was denoised."""
    paths = foreign.write_sequence(tmp_path / "in", spheres, foreign.blender)
    denoised(tmp_path / "in", tmp_path / "out")
    layers = foreign.blender(spheres[1])
    layers["ViewLayer.Noisy Image.RGBA"] *= 2
    foreign.write(paths[1], layers)
    os.utime(paths[1], (0, 0))
    whole = denoised(tmp_path / "in", tmp_path / "whole")
    if ends_by == "--frames":
        denoised(tmp_path / "in", tmp_path / "out", frame_range="1-3")
    else:
        write, written = SequenceDenoiser.write, []

        def write_two(self: SequenceDenoiser, files: FrameFiles, *rest: object) -> None:
            if len(written) == 2:
                raise KeyboardInterrupt
            written.append(files)
            write(self, files, *rest)

        monkeypatch.setattr(SequenceDenoiser, "write", write_two)
        with pytest.raises(KeyboardInterrupt):
            denoised(tmp_path / "in", tmp_path / "out")
        monkeypatch.undo()
    assert same(denoised(tmp_path / "in", tmp_path / "out"), whole)


def test_previews_are_of_the_image(spheres, tmp_path):
    """Not of the one before the frame was rendered again, and denoised without previews."""
    paths = foreign.write_sequence(tmp_path / "in", spheres[:1], foreign.blender)
    denoised(tmp_path / "in", tmp_path / "out", png=True)
    preview = (tmp_path / "out" / "0001.png").read_bytes()
    layers = foreign.blender(spheres[0])
    layers["ViewLayer.Noisy Image.RGBA"][:20] *= 2
    foreign.write(paths[0], layers)
    os.utime(paths[0], (0, 0))
    denoised(tmp_path / "in", tmp_path / "out")
    denoised(tmp_path / "in", tmp_path / "out", png=True)
    assert (tmp_path / "out" / "0001.png").read_bytes() != preview


def test_settings_are_never_mixed(spheres, tmp_path):
    foreign.write_sequence(tmp_path / "in", spheres, foreign.blender)
    with pytest.raises(BadInput, match="not a number of samples"):
        denoised(tmp_path / "in", tmp_path / "out", spp=math.nan)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "denoise.json").write_text("{}")  # of a run that failed before its first frame
    denoised(tmp_path / "in", tmp_path / "out")
    others = {"denoiser": "eaw", "reset_at": [2], "stored_as": "half", "motion": "XY,-x,+y,pixels", "spp": 4.0}
    for name, value in others.items():
        with pytest.raises(BadInput, match="denoised with other settings"):
            denoised(tmp_path / "in", tmp_path / "out", **{name: value})


def test_another_pass_is_another_setting(spheres, tmp_path):
    foreign.write_sequence(tmp_path / "in", spheres[:1], foreign.blender)
    for name in ("a", "b"):
        foreign.write(tmp_path / "albedo" / f"{name}_1.exr", {"RGB": foreign.image(spheres[0], "albedo")})
    denoised(tmp_path / "in", tmp_path / "out", alb=(str(tmp_path / "albedo" / "a_1.exr"),))
    with pytest.raises(BadInput, match=r"other settings \(passes\)"):
        denoised(tmp_path / "in", tmp_path / "out", alb=(str(tmp_path / "albedo" / "b_1.exr"),))


@pytest.mark.parametrize(("name", "option"), [("0001.png", {"png": True}), ("metrics.csv", {"ref": ("in/*.exr",)})])
def test_nothing_of_others_is_overwritten(spheres, tmp_path, monkeypatch, name, option):
    monkeypatch.chdir(tmp_path)
    foreign.write_sequence(Path("in"), spheres[:1], foreign.blender)
    Path("out").mkdir()
    Path("out", name).write_text("precious")
    with pytest.raises(BadInput, match=f"has a {name} that was not made here"):
        denoised(Path("in"), Path("out"), **option)
    assert contents(Path("out")) == {name: b"precious"}


def test_frames_without_history_do_not_depend_on_others(spheres, tmp_path):
    """The first one's normals turn no later frame: what is denoised after an interruption is the same."""

    def still(frame: Frame) -> foreign.Layers:
        angle = float(frame.direct.mean())
        turn = [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
        return {"RGB": foreign.beauty(frame), "N.XYZ": foreign.image(frame, "normal") @ np.float32(turn)}

    foreign.write_sequence(tmp_path / "in", spheres, still)
    whole = denoised(tmp_path / "in", tmp_path / "whole", "one")
    denoised(tmp_path / "in", tmp_path / "late", "one", frame_range="3-4")
    assert same(images_in(tmp_path / "late"), whole[2:])


def test_history_ends_at_resets_and_gaps(spheres, tmp_path, capsys):
    foreign.write_sequence(tmp_path / "in", spheres, foreign.blender)
    late = denoised(tmp_path / "in", tmp_path / "late", frame_range="3-4")
    assert same(denoised(tmp_path / "in", tmp_path / "reset", reset_at=[3])[2:], late)
    (tmp_path / "in" / "0002.exr").unlink()
    assert torch.equal(denoised(tmp_path / "in", tmp_path / "gap")[1], late[0])
    assert "missing before 3: history begins anew" in capsys.readouterr().out


def test_references_and_previews(spheres, tmp_path, capsys):
    foreign.write_sequence(tmp_path / "in", spheres, foreign.blender)
    foreign.write_sequence(tmp_path / "ref", spheres, lambda f: {"RGB": foreign.beauty(f) + 0.1})
    denoised(tmp_path / "in", tmp_path / "out", "noisy", ref=(str(tmp_path / "ref" / "*.exr"),), png=True)
    assert "mean RMSE" in capsys.readouterr().out
    rows = list(csv.DictReader((tmp_path / "out" / "metrics.csv").open()))
    assert [row["frame"] for row in rows] == ["1", "2", "3", "4"]
    with Picture.open(tmp_path / "out" / "0001.png") as shown:
        assert shown.size == (56, 40) and np.array(shown).std() > 1
    for row in rows:
        rmse = float(row["rmse"])
        assert 0 < rmse < 1 and float(row["psnr"]) == pytest.approx(-20 * math.log10(rmse))


def test_what_cannot_be_done_is_explained(spheres, tmp_path, capfd):
    paths = foreign.write_sequence(tmp_path / "in", spheres, foreign.blender)
    small = foreign.write(tmp_path / "alb" / "1.exr", {"RGB": np.ones((3, 3, 3))})
    for options, complaint in (
        ({"denoiser": "asvgf"}, "reads gradient, which only onespp renders"),
        ({"quality": "fast"}, "is an option of OIDN"),
        ({"ref": (str(paths[2]),)}, "has no reference of frame 1"),
        ({"alb": (str(small),), "frame_range": "1"}, r"1\.exr is 3x3 and .*0001\.exr 56x40"),
    ):
        with pytest.raises(BadInput, match=complaint):
            denoised(tmp_path / "in", tmp_path / "out", **options)
    shifted = {"dataWindow": (np.array([1, 0], np.int32), np.array([56, 39], np.int32))}
    foreign.write(tmp_path / "shifted" / "1.exr", {"RGB": foreign.image(spheres[0], "albedo")}, shifted)
    with pytest.raises(BadInput, match=r"begins at \(1, 0\) .* must have the same data window"):
        denoised(tmp_path / "in", tmp_path / "out", alb=(str(tmp_path / "shifted" / "1.exr"),), frame_range="1")
    with pytest.raises(BadInput, match="choose another folder"):
        denoised(tmp_path / "in", tmp_path / "in")
    assert not (tmp_path / "out").exists()
    others = contents(foreign.write_sequence(tmp_path / "clean", spheres, foreign.blender)[0].parent)
    with pytest.raises(BadInput, match=r"clean has a 0001\.exr that was not made here"):
        denoised(tmp_path / "in", tmp_path / "clean", ref=(str(tmp_path / "clean" / "*.exr"),))
    assert contents(tmp_path / "clean") == others
    foreign.write(tmp_path / "sizes" / "1.exr", foreign.blender(spheres[0]))
    larger = {layer: np.tile(image, (2, 2, 1)) for layer, image in foreign.blender(spheres[1]).items()}
    foreign.write(tmp_path / "sizes" / "2.exr", larger)
    with pytest.raises(BadInput, match=r"2\.exr is 112x80, unlike the frame before it"):
        denoised(tmp_path / "sizes", tmp_path / "out")
    paths[2].write_bytes(paths[2].read_bytes()[:3000])
    capfd.readouterr()
    with pytest.raises(BadInput, match=r"0003\.exr is damaged"):
        denoised(tmp_path / "in", tmp_path / "out", motion="XY,+x,-y,pixels")
    assert "EXR" not in "".join(capfd.readouterr()).replace("0003.exr", "")  # messages of the OpenEXR library
    assert contents(tmp_path / "out", "*.exr").keys() == {"0001.exr", "0002.exr"}
    shutil.copy(paths[0], paths[2])
    foreign.write(paths[1], {"ViewLayer.Noisy Image.RGBA": np.ones((40, 56, 4))})
    with pytest.raises(BadInput, match=r"0002\.exr has no channel"):
        denoised(tmp_path / "in", tmp_path / "other", motion="XY,+x,-y,pixels")


def test_a_data_window_that_moves_is_refused(tmp_path):
    for left in (0, 1):
        window = {"dataWindow": (np.array([left, 0], np.int32), np.array([left + 3, 3], np.int32))}
        foreign.write(tmp_path / "in" / f"{left}.exr", {"RGB": np.ones((4, 4, 3))}, window)
    with pytest.raises(BadInput, match=r"1\.exr begins at \(1, 0\) .* render all frames with the same data window"):
        denoised(tmp_path / "in", tmp_path / "out")


def test_deep_images_are_refused(tmp_path):
    deep = np.empty((2, 3), object)
    for place in np.ndindex(deep.shape):
        deep[place] = np.ones(2, np.float32)
    header = {"type": OpenEXR.deepscanline, "compression": OpenEXR.ZIPS_COMPRESSION}
    OpenEXR.File(header, {c: deep for c in "RGB"}).write(str(tmp_path / "1.exr"))
    with pytest.raises(BadInput, match=r"1\.exr: the channel 'R' is deep: flatten the image"):
        denoised(tmp_path, tmp_path / "out")


def test_negative_depth_is_not_taken_for_background(tmp_path):
    depth = np.full((4, 4, 1), -5.0)
    depth[0] = 1e10
    foreign.write(tmp_path / "1.exr", {"RGB": np.ones((4, 4, 3)), "Z": depth})
    with pytest.raises(BadInput, match=r"1\.exr: the depth is negative: change its sign"):
        denoised(tmp_path, tmp_path / "out")


@pytest.mark.parametrize(
    ("option", "of_ours", "message"),
    [
        ({"motion": "XY,-x,+y,pixels"}, False, "--motion XY,-x,.y,pixels: there is no motion layer"),
        ({"albedo": "sampled"}, False, "--albedo sampled: there is no albedo layer"),
        ({"motion": "garbage"}, True, "--motion is for other renderers"),
        ({"albedo": "exact"}, True, "--albedo is for other renderers"),
        ({"spp": 4.0}, True, "--spp is for other renderers"),
    ],
)
def test_options_that_do_not_apply_are_refused(tiny, tmp_path, option, of_ours, message):
    if of_ours:
        export_clip(Dataset(tiny).clips("test")[0].path, tmp_path / "in")
    else:
        foreign.write(tmp_path / "in" / "1.exr", {"RGB": np.ones((4, 4, 3))})
    with pytest.raises(BadInput, match=message):
        denoised(tmp_path / "in", tmp_path / "out", **option)
    assert not (tmp_path / "out").exists()


def test_the_command_takes_patterns_files_and_oidns_flags(spheres, tmp_path, capsys):
    for folder, layer in (("hdr", foreign.beauty), ("alb", lambda f: foreign.image(f, "albedo"))):
        foreign.write_sequence(tmp_path / folder, spheres, lambda f, _l=layer: {"RGB": _l(f)})
    names = [str(path) for path in sorted((tmp_path / "hdr").iterdir())]
    rest = ["--denoiser", "svgf", "--alb", str(tmp_path / "alb" / "*.exr"), "--threads", "1", "-r", names[0], names[1]]
    main(["denoise", *names, "--out", str(tmp_path / "a"), *rest, "--frames", "1-2"])
    main(["denoise", "--hdr", str(tmp_path / "hdr" / "*.exr"), "--out", str(tmp_path / "b"), *rest, "--frames", "1-2"])
    assert "albedo        R,G,B" in capsys.readouterr().out
    assert same(images_in(tmp_path / "a"), images_in(tmp_path / "b"))
    for words, complaint in (
        ([], "name the frames"),
        ([names[0], "--denoiser", "wskp6@tiny", "--runs", str(tmp_path / "none")], "onespp train wskp6 --budget tiny"),
        ([names[0], "--denoiser", "magic"], "unknown denoiser 'magic'"),
        ([names[0], "--denoiser", "wskp6", "-w", names[0]], "not a safetensors file"),
    ):
        assert complaint in fails(capsys, "denoise", *words, "--out", str(tmp_path / "c"))
    assert not (tmp_path / "c").exists()


@pytest.fixture
def buffers(spheres, tmp_path) -> list[str]:
    """Options by which `denoise` takes two sequences, in tmp_path / "a" and "b", of independent samples."""
    rng = np.random.default_rng(0)

    def sampled(frame: Frame) -> foreign.Layers:
        return {"RGB": foreign.beauty(frame) * rng.gamma(4, 1 / 4, (*frame.size, 1))}

    for folder in ("a", "b"):
        foreign.write_sequence(tmp_path / folder, spheres, sampled)
    return [
        str(tmp_path / "a" / "*.exr"),
        "--buffer-b",
        str(tmp_path / "b" / "*.exr"),
        "--threads",
        "1",
        "--as",
        "float",
    ]


def test_two_sample_buffers_are_averaged_and_shrunk_by(buffers, tmp_path):
    shown = {}
    for name in ("noisy", "eaw", "eaw+js"):
        main(["denoise", *buffers, "--denoiser", name, "--out", str(tmp_path / name)])
        shown[name] = images_in(tmp_path / name)
    a, b = (images_in(tmp_path / folder) for folder in ("a", "b"))
    for noisy, filtered, shrunk, first, second in zip(*shown.values(), a, b, strict=True):
        torch.testing.assert_close(noisy, (first + second) / 2)
        assert (shrunk >= torch.minimum(noisy, filtered) - 1e-5).all()
        assert (shrunk <= torch.maximum(noisy, filtered) + 1e-5).all()
        assert not torch.equal(shrunk, filtered)


def test_two_sample_buffers_give_the_error(buffers, tmp_path, capsys):
    out = tmp_path / "out"
    words = ["denoise", *buffers, "--denoiser", "svgf+js", "--spp", "4", "--png"]
    main([*words, "--out", str(tmp_path / "plain")])
    denoise_with_error = [*words, "--out", str(out), "--error", "--until", "0.02"]
    main(denoise_with_error)
    assert "0 of 4 frames have a relative error of at most 0.02; the others need" in capsys.readouterr().out
    for image, plain in zip(images_in(out), images_in(tmp_path / "plain"), strict=True):
        torch.testing.assert_close(image, plain)
    with (out / "error.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["spp"] for row in rows] == ["8.0"] * 4
    for row in rows:
        assert 0 < float(row["relative_error"]) < float(row["at_most"]) < 3
        assert float(row["samples"]) > 8
    assert all((image > 0).any() and (image >= 0).all() for image in images_in(out, "error."))

    before = contents(out)
    (out / "0003.exr").unlink()
    main(denoise_with_error)
    assert contents(out) == before
    (out / "error.csv").write_bytes(b"".join(before["error.csv"].splitlines(keepends=True)[:-1]))
    main(denoise_with_error)
    assert contents(out) == before

    capsys.readouterr()
    main([*denoise_with_error[:-1], "5"])  # another relative error: the frames stay as they are, the table follows
    assert "4 of 4 frames have a relative error of at most 5" in capsys.readouterr().out
    assert contents(out, "*.exr").items() <= before.items()
    main(denoise_with_error[:-2])
    with (out / "error.csv").open() as file:
        assert all(row["until"] == row["samples"] == "" for row in csv.DictReader(file))


def test_the_error_is_a_layer_of_the_part_that_holds_the_colour(tmp_path):
    """Of a file with another part before it, and with an older layer of that name."""
    names = {"mask": ("Y",), "image": ("R", "G", "B", "error.R")}
    parts = [OpenEXR.Part({}, {c: np.zeros((4, 6), np.float32) for c in names[part]}, part) for part in names]
    OpenEXR.File(parts).write(str(tmp_path / "in.exr"))
    image = ExrImage(tmp_path / "in.exr")
    image.add("error", np.full((4, 6, 3), 0.5, np.float32), next(name for name in image.channels if name.endswith("G")))
    image.write(tmp_path / "out.exr", "here")
    first, second = OpenEXR.File(str(tmp_path / "out.exr"), separate_channels=True).parts
    assert set(first.channels) == {"Y"} and set(second.channels) == {"R", "G", "B", "error.R", "error.G", "error.B"}
    assert all((second.channels[f"error.{c}"].pixels == 0.5).all() for c in "RGB")


def test_impossible_errors_are_refused(buffers, tmp_path, capsys):
    a, _, b, *_ = buffers
    for words, complaint in (
        (f"{a} --buffer-b {a} --denoiser svgf+js", "different seeds"),
        (f"{a} --buffer-b {b} --denoiser svgf --error", "use svgf+js"),
        (f"{a} --buffer-b {b} --denoiser svgf+js --until 0", "no relative error"),
        (f"{a} --denoiser svgf+js --error", "--buffer-b"),
    ):
        assert complaint in fails(capsys, "denoise", *words.split(), "--out", str(tmp_path / "out"))
    assert not list(tmp_path.glob("out/*.exr"))


def test_our_own_frames_contain_their_buffers(tiny, tmp_path):
    clip = next(clip for clip in Dataset(tiny).clips("train") if clip.scene == "cornell_box")
    two = with_samples(clip, Dataset(tiny), 2, tmp_path / "clips", with_buffers=True)
    export_clip(two.path, tmp_path / "exr")
    images = denoised(tmp_path / "exr", tmp_path / "out", "eaw+js", error=True, until=0.5)
    denoiser = load("eaw+js", None, signal="total")
    assert same(images, run(denoiser, (read_frame(two, index, denoiser.reads) for index in range(two.frames))))
    assert len(ErrorTable(tmp_path / "out").rows) == two.frames
    export_clip(clip.path, tmp_path / "without")
    with pytest.raises(BadInput, match="need two sample buffers"):
        denoised(tmp_path / "without", tmp_path / "none", "svgf+js", error=True)
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize("name", ["svgf", "eaw", "wskp3", "oidn"])
@pytest.mark.parametrize("layers", [foreign.blender, foreign.pbrt])
def test_one_pixel(spheres, tmp_path, name, layers: Callable[[Frame], foreign.Layers]):
    pixel = [frame.map(lambda channel: channel[..., 30:31, 20:21]) for frame in spheres[:2]]
    foreign.write_sequence(tmp_path / "in", pixel, layers)
    weights = fresh_weights(name, tmp_path / "w") if name == "wskp3" else None
    images = denoised(tmp_path / "in", tmp_path / "out", name, weights=weights)
    assert all(torch.isfinite(image).all() for image in images)


def test_normals_in_the_range_of_colours_are_recognised(box, tmp_path, capsys):
    def encoded(frame: Frame) -> foreign.Layers:
        layers = foreign.blender(frame)
        return layers | {"ViewLayer.Normal.XYZ": layers["ViewLayer.Normal.XYZ"] / 2 + 0.5}

    foreign.write_sequence(tmp_path / "plain", box, foreign.blender)
    foreign.write_sequence(tmp_path / "in", box, encoded)
    expected = denoised(tmp_path / "plain", tmp_path / "expected")
    assert "scaled" not in capsys.readouterr().out
    assert error(denoised(tmp_path / "in", tmp_path / "out"), expected) < 1e-4
    assert "normal        scaled from [0, 1] to [-1, 1]" in capsys.readouterr().out


def test_layers_that_add_up_to_the_colour_do_so_denoised(tiny, tmp_path):
    clip = next(clip for clip in Dataset(tiny).clips("test") if clip.scene == "cornell_box_moving")
    export_clip(clip.path, tmp_path / "in")
    options = {"frame_range": "0-2", "stored_as": "float"}
    lit = denoised(tmp_path / "in", tmp_path / "out", "one", aov=("depth.Z", "direct", "indirect"), **options)
    direct, indirect, emission = (
        images_in(tmp_path / "out", f"{name}.") for name in ("direct", "indirect", "emission")
    )
    for whole, *parts in zip(lit, direct, indirect, emission, strict=True):
        torch.testing.assert_close(sum(parts), whole, rtol=1e-4, atol=1e-5 * float(whole.max()))
    assert same(lit, denoised(tmp_path / "in", tmp_path / "alone", "one", **options))
    before, after = (
        foreign.read(tmp_path / folder / sorted(os.listdir(tmp_path / "in"))[0]) for folder in ("in", "out")
    )
    assert before["depth.Z"].min() <= after["depth.Z"].min() and after["depth.Z"].max() <= before["depth.Z"].max()


def test_layers_behind_glass_add_up_to_the_whole(tmp_path):
    frame = glass_frame(0, noise=1.0)
    names = ("direct", "indirect")
    foreign.write(tmp_path / "1.exr", {f"{name}.RGB": foreign.image(frame, name) for name in names})
    image = ExrImage(tmp_path / "1.exr")
    parts = Parts.named(names, image, create("one"))
    frame = parts.added(frame, image)
    with torch.inference_mode():
        whole, state = parts.denoiser(frame, None)
        parts.write(image, frame, state, np.float32)
    total = sum(image.stacked([f"{name}.{letter}" for letter in "RGB"]) for name in names)
    shown = whole[0].permute(1, 2, 0).numpy() - foreign.image(frame, "emission")
    np.testing.assert_allclose(total, shown, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("denoiser", "layer", "message"),
    [("svgf", "direct", "--denoiser one"), ("one", "key light", "no layer or channel 'key light'.*direct.BGR")],
)
def test_layers_that_cannot_be_denoised_are_refused(tiny, tmp_path, denoiser, layer, message):
    clip = Dataset(tiny).clips("test")[0]
    export_clip(clip.path, tmp_path / "in")
    with pytest.raises(BadInput, match=message):
        denoised(tmp_path / "in", tmp_path / "out", denoiser, aov=(layer,))
