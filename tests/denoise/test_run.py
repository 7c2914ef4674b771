"""Whole sequences under other people's names, from files to files."""

import csv
import hashlib
import json
import math
import os
import shutil
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
from denoise.error_table import ErrorTable
from denoise.exr_image import ExrImage
from denoise.job import Job
from denoise.run import denoise
from errors import BadInput
from eval.tradeoff.resampled_clips import with_samples
from models.registry import create
from models.spec import load
from models.weights import save_weights
from tests.denoise.conftest import as_foreign
from tests.helpers import foreign
from tests.helpers.frames import run


def job(folder: Path, out: Path, denoiser: str = "svgf", weights: Path | None = None, **options: object) -> Job:
    return Job((str(folder / "*.exr"),), denoiser, out, weights, **options)


def outputs(out: Path, layer: str = "") -> list[Tensor]:
    """Denoised images (1, 3, H, W), in order."""
    found = []
    for path in sorted(out.glob("*.exr")):
        planes = foreign.read(path)
        found.append(torch.from_numpy(np.stack([planes[f"{layer}{c}"] for c in "RGB"]).astype(np.float32))[None])
    return found


def error(a: list[Tensor], b: list[Tensor]) -> float:
    """RMSE of what is shown of two sequences."""
    pairs = zip(a, b, strict=True)
    return math.sqrt(np.mean([(x.clamp(0, 1) - y.clamp(0, 1)).square().mean().item() for x, y in pairs]))


def fresh_weights(name: str, path: Path) -> Path:
    torch.manual_seed(0)
    save_weights(create(name), name, {}, path)
    return path


@pytest.mark.parametrize("name", ["svgf", "wskp6", "ntd", "asvgf"])
def test_our_own_clip_gives_the_same_from_exr(tiny, tmp_path, name, capsys):
    clip = next(clip for clip in Dataset(tiny).clips("test") if clip.scene == "cornell_box_moving")
    export_clip(clip.path, tmp_path / "exr")
    weights = fresh_weights(name, tmp_path / "w") if create(name).is_network else None
    denoise(job(tmp_path / "exr", tmp_path / "out", name, weights, frame_range="0-5"))
    denoiser = load(name, weights, signal="total")
    expected = run(denoiser, (read_frame(clip, index, denoiser.reads) for index in range(6)))
    assert all(torch.equal(a, b) for a, b in zip(outputs(tmp_path / "out"), expected, strict=True))
    assert "onespp's own" in capsys.readouterr().out


def test_pbrt_names_give_what_the_frames_give(box, tmp_path, capsys):
    foreign.write_sequence(tmp_path / "in", box, foreign.pbrt)
    denoise(job(tmp_path / "in", tmp_path / "out"))
    said = capsys.readouterr().out
    assert "cameras       from the positions" in said and "motion        derived" in said
    expected = run(create("svgf"), map(as_foreign, box))
    assert error(outputs(tmp_path / "out"), expected) < 0.01 * error(expected, [torch.zeros_like(x) for x in expected])


def test_positions_in_camera_space_need_the_cameras_matrix(box, tmp_path, capsys):
    for index, frame in enumerate(box):
        to_camera = np.linalg.inv(foreign.view(frame).camera_to_world)
        layers = foreign.pbrt(frame)
        layers["P.XYZ"] = layers["P.XYZ"] @ to_camera[:3, :3].T + to_camera[:3, 3]
        layers["Ns.XYZ"] = layers["Ns.XYZ"] @ to_camera[:3, :3].T
        matrix = {"worldToCamera": np.ascontiguousarray(to_camera.T, np.float32)}
        foreign.write(tmp_path / "in" / f"{index}.exr", layers, matrix)
        foreign.write(tmp_path / "without" / f"{index}.exr", layers)
    denoise(job(tmp_path / "in", tmp_path / "out"))
    assert "moved to the world by worldToCamera" in capsys.readouterr().out
    expected = run(create("svgf"), map(as_foreign, box))
    assert error(outputs(tmp_path / "out"), expected) < 0.01 * error(expected, [torch.zeros_like(x) for x in expected])
    denoise(job(tmp_path / "without", tmp_path / "alone"))
    assert "none: no history" in capsys.readouterr().out


def test_blenders_names_keep_most_of_the_history(box, tmp_path, capsys):
    foreign.write_sequence(tmp_path / "in", box, foreign.blender)
    denoise(job(tmp_path / "in", tmp_path / "out"))
    said = capsys.readouterr().out
    assert "ViewLayer.Noisy Image" in said and "XY,+x,-y,pixels" in said and "warp error" in said
    denoiser = create("svgf")
    expected = run(denoiser, map(as_foreign, box))
    alone = [denoiser(as_foreign(frame), None)[0] for frame in box]
    found = outputs(tmp_path / "out", "ViewLayer.Combined.")
    assert error(found, expected) < 0.4 * error(alone, expected)
    assert torch.allclose(found[0], expected[0], rtol=1e-4, atol=1e-5)  # where there is no history, nothing is lost


def test_the_sky_stays_as_it_is_and_only_the_image_changes(spheres, tmp_path):
    options = {"header": {"owner": "me", "worldToCamera": np.eye(4, dtype=np.float32)}, "dtype": np.float16}
    before = foreign.write_sequence(tmp_path / "in", spheres, foreign.blender, **options)
    denoise(job(tmp_path / "in", tmp_path / "out"))
    for path, frame in zip(before, spheres, strict=True):
        old, new = foreign.read(path), foreign.read(tmp_path / "out" / path.name)
        header = foreign.header(tmp_path / "out" / path.name)
        assert old.keys() == new.keys() and header["owner"] == "me" and header["denoised"] == "onespp svgf"
        np.testing.assert_array_equal(header["worldToCamera"], np.eye(4))
        assert all(new[name].dtype == np.float16 for name in new)
        replaced = {f"ViewLayer.Combined.{c}" for c in "RGB"}
        assert all((old[name].tobytes() == new[name].tobytes()) == (name not in replaced) for name in old)
        sky = frame.depth[0, 0].numpy() == 0
        for c in "RGB":
            np.testing.assert_array_equal(new[f"ViewLayer.Combined.{c}"][sky], old[f"ViewLayer.Noisy Image.{c}"][sky])


@pytest.mark.parametrize("style", ["beauty", "optix", "files"])
def test_names_and_files_do_not_matter(spheres, tmp_path, style):
    """The same passes, under other layers' names or in files of their own, give the same."""

    def plain(frame: Frame) -> foreign.Layers:
        layers = {"RGB": foreign.beauty(frame), "albedo.RGB": foreign.image(frame, "albedo")}
        layers |= {"N.XYZ": foreign.image(frame, "normal"), "Z": foreign.image(frame, "depth")}
        return layers | {"motion.XY": foreign.image(frame, "motion")}

    names = {
        "beauty": {
            "RGB": "rgba.Beauty.RGB",
            "albedo.RGB": "DiffCol.RGB",
            "N.XYZ": "Denoising Normal.XYZ",
            "Z": "Depth.V",
        },
        "optix": {
            "albedo.RGB": "VisibleDiffuse.RGB",
            "N.XYZ": "OptixNormals.XYZ",
            "Z": "depth.Z",
            "motion.XY": "mv.RG",
        },
        "files": {},
    }[style]
    foreign.write_sequence(tmp_path / "plain", spheres, plain)
    passes = {}
    if style == "files":
        for name, layer in {"alb": "albedo.RGB", "nrm": "N.XYZ", "depth": "Z", "mv": "motion.XY"}.items():
            letters = "RGB"[: 1 if layer == "Z" else 2 if layer == "motion.XY" else 3]
            foreign.write_sequence(tmp_path / name, spheres, lambda f, _l=layer, _c=letters: {_c: plain(f)[_l]})
            passes[name] = (str(tmp_path / name / "*.exr"),)
    renamed = "RGB" if style == "files" else None
    foreign.write_sequence(
        tmp_path / "in",
        spheres,
        lambda f: {names.get(k, k): v for k, v in plain(f).items() if renamed in (None, k)},
    )
    denoise(job(tmp_path / "plain", tmp_path / "expected"))
    denoise(job(tmp_path / "in", tmp_path / "out", **passes))
    layer = "rgba.Beauty." if style == "beauty" else ""
    pairs = zip(outputs(tmp_path / "out", layer), outputs(tmp_path / "expected"), strict=True)
    assert all(torch.equal(a, b) for a, b in pairs)


def test_a_mapping_for_names_that_nobody_knows(spheres, tmp_path):
    foreign.write_sequence(
        tmp_path / "in", spheres, lambda f: {"Foo.RGB": foreign.beauty(f), "Bar.RGB": foreign.image(f, "albedo")}
    )
    with pytest.raises(
        BadInput, match=r"no layer known to be radiance; it has Bar\.BGR, Foo\.BGR: name it by --layers"
    ):
        denoise(job(tmp_path / "in", tmp_path / "out"))
    assert not (tmp_path / "out").exists()
    denoise(job(tmp_path / "in", tmp_path / "out", "noisy", layers=["colour=Foo", "albedo=Bar"]))
    truth = [frame.radiance("total") for frame in spheres]
    assert all(torch.allclose(a, b) for a, b in zip(outputs(tmp_path / "out", "Foo."), truth, strict=True))


def test_colour_alone_is_denoised_frame_by_frame(spheres, tmp_path, capsys):
    foreign.write_sequence(tmp_path / "in", spheres, lambda f: {"RGB": foreign.beauty(f)})
    denoise(job(tmp_path / "in", tmp_path / "out"))
    said = capsys.readouterr().out
    for words in (
        "none: no history",
        "none: radiance is filtered",
        "as if all faced the viewer",
        "1 for every surface",
    ):
        assert words in said
    denoise(job(tmp_path / "in", tmp_path / "one", frame_range="3"))
    assert torch.equal(outputs(tmp_path / "one")[0], outputs(tmp_path / "out")[2])
    noise = [
        (image[..., 1:] - image[..., :-1]).abs().mean()
        for image in (outputs(tmp_path / "out")[0], foreign_beauty(spheres[0]))
    ]
    assert noise[0] < noise[1] / 2


def foreign_beauty(frame: Frame) -> Tensor:
    return frame.radiance("total")


def test_multi_part_files(spheres, tmp_path):
    layers = [
        foreign.planes(part)
        for part in ({"RGB": foreign.beauty(spheres[0])}, {"XYZ": foreign.image(spheres[0], "normal")})
    ]
    parts = [
        OpenEXR.Part({**foreign.HEADER, "owner": name}, each, name)
        for name, each in zip(["rgba", "N"], layers, strict=True)
    ]
    with OpenEXR.File(parts) as file:
        file.write(str(tmp_path / "1.exr"))
    denoise(Job((str(tmp_path / "1.exr"),), "svgf", tmp_path / "out"))
    with OpenEXR.File(str(tmp_path / "out" / "1.exr"), separate_channels=True) as file:
        assert [part.name() for part in file.parts] == ["rgba", "N"] and file.parts[1].header["owner"] == "N"
        np.testing.assert_array_equal(file.parts[1].channels["Z"].pixels, foreign.image(spheres[0], "normal")[..., 2])
        assert np.abs(file.parts[0].channels["R"].pixels - foreign.beauty(spheres[0])[..., 0]).max() > 0.1


def test_bad_pixels_are_counted_and_stay_where_they_are(spheres, tmp_path, capsys):
    def broken(frame: Frame) -> foreign.Layers:
        layers = foreign.blender(frame)
        layers["ViewLayer.Noisy Image.RGBA"][30, 20, 1] = np.nan
        layers["ViewLayer.Denoising Albedo.RGB"][31, 21] = np.inf
        layers["ViewLayer.Vector.XYZW"][32, 22] = np.nan
        return layers

    foreign.write_sequence(tmp_path / "in", spheres, broken)
    denoise(job(tmp_path / "in", tmp_path / "out"))
    assert "12 pixels were not finite" in capsys.readouterr().out
    assert all(torch.isfinite(image).all() for image in outputs(tmp_path / "out", "ViewLayer.Combined."))


def test_radiance_is_not_clamped_and_precision_is_the_inputs_or_stated(tmp_path):
    bright = {"RGB": np.full((4, 4, 3), 3e5), "Z": np.ones((4, 4, 1))}
    foreign.write(tmp_path / "in" / "1.exr", bright)
    for stored_as, dtype, value in ((None, np.float32, 3e5), ("half", np.float16, 65504)):
        denoise(job(tmp_path / "in", tmp_path / str(stored_as), "noisy", stored_as=stored_as))
        plane = foreign.read(tmp_path / str(stored_as) / "1.exr")["R"]
        assert plane.dtype == dtype and (plane == value).all()


def test_the_command_takes_shipped_weights_or_a_budgets_or_a_file(spheres, tmp_path, shipped):
    foreign.write_sequence(tmp_path / "in", spheres, foreign.blender)
    ours = fresh_weights("wskp3", shipped / "wskp3.safetensors")
    trained = tmp_path / "runs" / "train" / "wskp3-tiny" / "weights.safetensors"
    trained.parent.mkdir(parents=True)
    others = {key: 2 * tensor for key, tensor in create("wskp3").state_dict().items()}
    network = create("wskp3")
    network.load_state_dict(others)
    save_weights(network, "wskp3", {}, trained)
    call = ["denoise", str(tmp_path / "in" / "*.exr"), "--frames", "1-2", "--runs", str(tmp_path / "runs")]
    main([*call, "--denoiser", "wskp3", "--out", str(tmp_path / "ours")])
    main([*call, "--denoiser", "wskp3@tiny", "--out", str(tmp_path / "trained")])
    main([*call, "--denoiser", "wskp3", "-w", str(trained), "--out", str(tmp_path / "file")])
    for out, weights in (("ours", ours), ("trained", trained), ("file", trained)):
        noted = json.loads((tmp_path / out / "denoise.json").read_text())
        assert noted["weights"] == hashlib.sha256(weights.read_bytes()).hexdigest()
    a, b, c = (outputs(tmp_path / out, "ViewLayer.Combined.")[-1] for out in ("ours", "trained", "file"))
    assert torch.equal(b, c) and not torch.equal(a, b)


@pytest.mark.parametrize("name", ["svgf", "noisy"])
def test_an_interrupted_run_goes_on_to_the_same(spheres, tmp_path, name):
    foreign.write_sequence(tmp_path / "in", [*spheres, *spheres[::-1]], foreign.blender)
    options = {"denoiser": name, "reset_at": [5], "png": True}
    denoise(job(tmp_path / "in", tmp_path / "whole", **options))
    denoise(job(tmp_path / "in", tmp_path / "again", **options))
    for lost in ("0003.exr", "0007.exr", "0008.png"):
        (tmp_path / "again" / lost).unlink()
    kept = (tmp_path / "again" / "0005.exr").stat().st_mtime_ns
    denoise(job(tmp_path / "in", tmp_path / "again", **options))
    assert sorted(p.name for p in (tmp_path / "again").iterdir()) == sorted(
        p.name for p in (tmp_path / "whole").iterdir()
    )
    for path in (tmp_path / "whole").iterdir():
        assert path.read_bytes() == (tmp_path / "again" / path.name).read_bytes(), path.name
    assert (tmp_path / "again" / "0005.exr").stat().st_mtime_ns == kept


def test_a_frame_rendered_anew_is_denoised_anew_with_all_that_follow_from_it(spheres, tmp_path, capsys):
    paths = foreign.write_sequence(tmp_path / "in", spheres, foreign.blender)
    denoise(job(tmp_path / "in", tmp_path / "out"))
    later = (tmp_path / "out" / paths[2].name).stat().st_mtime + 10
    os.utime(paths[2], (later, later))
    capsys.readouterr()
    denoise(job(tmp_path / "in", tmp_path / "out"))
    assert "2 of them new" in capsys.readouterr().out


def test_settings_are_never_mixed(spheres, tmp_path):
    foreign.write_sequence(tmp_path / "in", spheres, foreign.blender)
    denoise(job(tmp_path / "in", tmp_path / "out"))
    others = {"denoiser": "eaw", "reset_at": [2], "stored_as": "half", "motion": "XY,-x,+y,pixels", "spp": 4.0}
    for name, value in others.items():
        with pytest.raises(BadInput, match="denoised with other settings"):
            denoise(job(tmp_path / "in", tmp_path / "out", **{name: value}))


def test_history_ends_at_resets_and_gaps(spheres, tmp_path, capsys):
    foreign.write_sequence(tmp_path / "in", spheres, foreign.blender)
    denoise(job(tmp_path / "in", tmp_path / "reset", reset_at=[3]))
    denoise(job(tmp_path / "in", tmp_path / "late", frame_range="3-4"))
    layer = "ViewLayer.Combined."
    pairs = zip(outputs(tmp_path / "reset", layer)[2:], outputs(tmp_path / "late", layer), strict=True)
    assert all(torch.equal(a, b) for a, b in pairs)
    (tmp_path / "in" / "0002.exr").unlink()
    denoise(job(tmp_path / "in", tmp_path / "gap"))
    assert "missing before 3: history begins anew" in capsys.readouterr().out
    assert torch.equal(outputs(tmp_path / "gap", layer)[1], outputs(tmp_path / "late", layer)[0])


def test_references_and_previews(spheres, tmp_path, capsys):
    foreign.write_sequence(tmp_path / "in", spheres, foreign.blender)
    foreign.write_sequence(tmp_path / "ref", spheres, lambda f: {"RGB": foreign.beauty(f) + 0.1})
    denoise(job(tmp_path / "in", tmp_path / "out", "noisy", ref=(str(tmp_path / "ref" / "*.exr"),), png=True))
    assert "mean RMSE" in capsys.readouterr().out
    rows = list(csv.DictReader((tmp_path / "out" / "metrics.csv").open()))
    assert [row["frame"] for row in rows] == ["1", "2", "3", "4"]
    first = foreign.beauty(spheres[0])
    with Picture.open(tmp_path / "out" / "0001.png") as shown:
        exposure = np.median((np.array(shown)[30:, :, 0] / 255) ** 2.2 / np.maximum(first[30:, :, 0], 1e-6))
    assert np.isfinite(exposure)
    assert all(
        0 < float(row["rmse"]) < 1 and float(row["psnr"]) == pytest.approx(-20 * math.log10(float(row["rmse"])))
        for row in rows
    )


def test_what_cannot_be_done_is_said(spheres, tmp_path):
    paths = foreign.write_sequence(tmp_path / "in", spheres, foreign.blender)
    with pytest.raises(BadInput, match="reads gradient, which only onespp renders"):
        denoise(job(tmp_path / "in", tmp_path / "out", "asvgf"))
    with pytest.raises(BadInput, match="is an option of OIDN"):
        denoise(job(tmp_path / "in", tmp_path / "out", quality="fast"))
    with pytest.raises(BadInput, match="choose another folder"):
        denoise(job(tmp_path / "in", tmp_path / "in"))
    with pytest.raises(BadInput, match="has no reference of frame 1"):
        denoise(job(tmp_path / "in", tmp_path / "out", ref=(str(paths[2]),)))
    small = foreign.write(tmp_path / "alb" / "1.exr", {"RGB": np.ones((3, 3, 3))})
    with pytest.raises(BadInput, match=r"1\.exr is 3x3 and .*0001\.exr 56x40"):
        denoise(job(tmp_path / "in", tmp_path / "out", alb=(str(small),), frame_range="1"))
    assert not (tmp_path / "out").exists()
    paths[2].write_bytes(paths[2].read_bytes()[:3000])
    with pytest.raises(BadInput, match=r"0003\.exr is damaged"):
        denoise(job(tmp_path / "in", tmp_path / "out", motion="XY,+x,-y,pixels"))
    assert sorted(path.name for path in (tmp_path / "out").glob("*.exr")) == ["0001.exr", "0002.exr"]
    shutil.copy(paths[0], paths[2])
    foreign.write(paths[1], {"ViewLayer.Noisy Image.RGBA": np.ones((40, 56, 4))})
    with pytest.raises(BadInput, match=r"0002\.exr has no channel"):
        denoise(job(tmp_path / "in", tmp_path / "other", motion="XY,+x,-y,pixels"))


def test_the_command_takes_patterns_files_and_oidns_flags(spheres, tmp_path, capsys):
    for folder, layer in (("hdr", foreign.beauty), ("alb", lambda f: foreign.image(f, "albedo"))):
        foreign.write_sequence(tmp_path / folder, spheres, lambda f, _l=layer: {"RGB": _l(f)})
    names = [str(path) for path in sorted((tmp_path / "hdr").iterdir())]
    rest = ["--denoiser", "svgf", "--alb", str(tmp_path / "alb" / "*.exr"), "--threads", "1", "-r", names[0], names[1]]
    main(["denoise", *names, "--out", str(tmp_path / "a"), *rest, "--frames", "1-2"])
    main(["denoise", "--hdr", str(tmp_path / "hdr" / "*.exr"), "--out", str(tmp_path / "b"), *rest, "--frames", "1-2"])
    assert "albedo        R,G,B" in capsys.readouterr().out
    assert all(torch.equal(a, b) for a, b in zip(outputs(tmp_path / "a"), outputs(tmp_path / "b"), strict=True))
    for arguments, complaint in (
        ([], "name the frames"),
        ([names[0], "--denoiser", "wskp6@tiny", "--runs", str(tmp_path / "none")], "onespp train wskp6 --budget tiny"),
        ([names[0], "--denoiser", "magic"], "unknown denoiser 'magic'"),
        ([names[0], "--denoiser", "wskp6", "-w", names[0]], "not a safetensors file"),
    ):
        with pytest.raises(SystemExit) as exit_:
            main(["denoise", *arguments, "--out", str(tmp_path / "c")])
        assert exit_.value.code == 2 and complaint in capsys.readouterr().err
    assert not (tmp_path / "c").exists()


@pytest.fixture
def halves(spheres, tmp_path) -> list[str]:
    """The words by which `denoise` takes two sequences, in tmp_path / "a" and "b", of other samples of the same."""
    rng = np.random.default_rng(0)

    def sampled(frame: Frame) -> np.ndarray:
        return foreign.beauty(frame) * rng.gamma(4, 1 / 4, (*frame.size, 1))

    for folder in ("a", "b"):
        foreign.write_sequence(tmp_path / folder, spheres, lambda f: {"RGB": sampled(f)})
    return [str(tmp_path / "a" / "*.exr"), "--half", str(tmp_path / "b" / "*.exr"), "--threads", "1", "--as", "float"]


def test_another_half_of_the_samples_is_averaged_and_shrunk_by(halves, tmp_path):
    a, b = (outputs(tmp_path / folder) for folder in ("a", "b"))
    shown = {}
    for name in ("noisy", "eaw", "eaw+js"):
        main(["denoise", *halves, "--denoiser", name, "--out", str(tmp_path / name)])
        shown[name] = outputs(tmp_path / name)
    for noisy, filtered, shrunk, first, second in zip(*(shown[n] for n in shown), a, b, strict=True):
        torch.testing.assert_close(noisy, (first + second) / 2)
        assert (shrunk >= torch.minimum(noisy, filtered) - 1e-5).all()
        assert (shrunk <= torch.maximum(noisy, filtered) + 1e-5).all()
        assert not torch.equal(shrunk, filtered)


def test_halves_tell_how_far_frames_are_from_the_truth(halves, tmp_path, capsys):
    words = ["denoise", *halves, "--denoiser", "svgf+js", "--spp", "4", "--png"]
    main([*words, "--out", str(tmp_path / "plain")])
    capsys.readouterr()
    told = [*words, "--out", str(tmp_path / "out"), "--error", "--until", "0.02"]
    main(told)
    said = capsys.readouterr().out
    assert "0 of 4 frames have a relative error of at most 0.02; the others need" in said
    for ours, theirs in zip(outputs(tmp_path / "out"), outputs(tmp_path / "plain"), strict=True):
        torch.testing.assert_close(ours, theirs)
    with (tmp_path / "out" / "error.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["spp"] for row in rows] == ["8.0"] * 4
    for row in rows:
        assert 0 < float(row["relative_error"]) < float(row["at_most"]) < 3
        assert float(row["samples"]) > 8
    assert all((image > 0).any() and (image >= 0).all() for image in outputs(tmp_path / "out", "error."))

    before = {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()}
    (tmp_path / "out" / sorted(name for name in before if name.endswith(".exr"))[2]).unlink()
    main(told)
    assert {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()} == before
    lines = (tmp_path / "out" / "error.csv").read_text().splitlines()
    (tmp_path / "out" / "error.csv").write_text("\n".join(lines[:-1]) + "\n")
    main(told)
    assert (tmp_path / "out" / "error.csv").read_bytes() == before["error.csv"]

    capsys.readouterr()
    main([*told[:-1], "5"])  # another relative error: the frames stay as they are, the table follows
    assert "4 of 4 frames have a relative error of at most 5" in capsys.readouterr().out
    assert {path.name: path.read_bytes() for path in (tmp_path / "out").glob("*.exr")}.items() <= before.items()
    main(told[:-2])
    with (tmp_path / "out" / "error.csv").open() as file:
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


def test_halves_that_are_one_are_refused(halves, tmp_path, capsys):
    with pytest.raises(SystemExit):
        main(["denoise", halves[0], "--half", halves[0], "--denoiser", "svgf+js", "--out", str(tmp_path / "out")])
    assert "different seeds" in capsys.readouterr().err


def test_our_own_frames_have_their_halves_with_them(tiny, tmp_path):
    clip = next(clip for clip in Dataset(tiny).clips("train") if clip.scene == "cornell_box")
    two = with_samples(clip, Dataset(tiny), 2, "averaged", tmp_path / "clips", halves=True)
    export_clip(two.path, tmp_path / "exr")
    denoise(job(tmp_path / "exr", tmp_path / "out", "eaw+js", error=True, until=0.5))
    denoiser = load("eaw+js", None, signal="total")
    expected = run(denoiser, (read_frame(two, index, denoiser.reads) for index in range(two.frames)))
    assert all(torch.equal(a, b) for a, b in zip(outputs(tmp_path / "out"), expected, strict=True))
    assert len(ErrorTable(tmp_path / "out").rows) == two.frames


def test_our_own_frames_without_halves_tell_no_error(tiny, tmp_path):
    export_clip(next(iter(Dataset(tiny).clips("test"))).path, tmp_path / "exr")
    with pytest.raises(BadInput, match="need two halves"):
        denoise(job(tmp_path / "exr", tmp_path / "out", "svgf+js", error=True))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "words, complaint",
    [
        (["--denoiser", "svgf", "--error"], "use svgf+js"),
        (["--denoiser", "svgf+js", "--until", "0"], "no relative error"),
    ],
)
def test_errors_that_cannot_be_told_are_refused(halves, tmp_path, capsys, words, complaint):
    with pytest.raises(SystemExit) as exit_:
        main(["denoise", *halves, *words, "--out", str(tmp_path / "out")])
    assert exit_.value.code == 2 and complaint in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_an_error_takes_halves(halves, tmp_path, capsys):
    with pytest.raises(SystemExit) as exit_:
        main(["denoise", halves[0], "--denoiser", "svgf+js", "--error", "--out", str(tmp_path / "out")])
    assert exit_.value.code == 2 and "--half" in capsys.readouterr().err and not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["svgf", "eaw", "wskp3", "oidn"])
@pytest.mark.parametrize("layers", [foreign.blender, foreign.pbrt])
def test_one_pixel(spheres, tmp_path, name, layers):
    pixel = [frame.map(lambda channel: channel[..., 30:31, 20:21]) for frame in spheres[:2]]
    foreign.write_sequence(tmp_path / "in", pixel, layers)
    weights = fresh_weights(name, tmp_path / "w") if name == "wskp3" else None
    denoise(job(tmp_path / "in", tmp_path / "out", name, weights))
    layer = "ViewLayer.Combined." if layers is foreign.blender else ""
    assert all(torch.isfinite(image).all() for image in outputs(tmp_path / "out", layer))


def test_normals_in_the_range_of_colours_are_recognised(box, tmp_path, capsys):
    def encoded(frame: Frame) -> foreign.Layers:
        layers = foreign.blender(frame)
        return layers | {"ViewLayer.Normal.XYZ": layers["ViewLayer.Normal.XYZ"] / 2 + 0.5}

    foreign.write_sequence(tmp_path / "plain", box, foreign.blender)
    foreign.write_sequence(tmp_path / "in", box, encoded)
    denoise(job(tmp_path / "plain", tmp_path / "expected"))
    assert "scaled" not in capsys.readouterr().out
    denoise(job(tmp_path / "in", tmp_path / "out"))
    assert "normal        scaled from [0, 1] to [-1, 1]" in capsys.readouterr().out
    layer = "ViewLayer.Combined."
    assert error(outputs(tmp_path / "out", layer), outputs(tmp_path / "expected", layer)) < 1e-4
