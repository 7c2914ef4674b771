"""Files of other people become datasets: written here by their documented formats, with known cameras."""

import shutil

import numpy as np
import OpenEXR
import pytest

import onespp
from datasets.bmfr_files import import_bmfr
from datasets.clip import Clip, Dataset
from datasets.frame import read_frame
from datasets.imported import write_dataset
from datasets.info import summarise
from datasets.noisebase_files import CROPPED_ROWS, import_noisebase
from datasets.oidn_layout import export_dataset
from datasets.tonemap import display
from errors import BadInput
from eval.figures.show import view_clip
from eval.tradeoff.samples import scene_of
from models.registry import create
from scenes.camera import STILL, View, directions, intrinsics, look_at, motion_vectors, pixel_centres
from tests.test_cli import fails

SIZE = 72, 96
FRAMES = 3


def view(index, size=SIZE):
    eye = np.array([0.1 * index, 0.2, 0.0])
    return View(intrinsics(60.0, *size), look_at(eye, np.array([0.0, 0.1 * index, -5.0])), STILL)


def positions(view, size=SIZE):
    """The points (H, W, 3) of a tilted plane that pixels show: z = -5 + x / 4."""
    ray = directions(pixel_centres(*size), view)
    normal = np.array([-0.25, 0.0, 1.0])
    eye = view.camera_to_world[:3, 3]
    return eye + (-5 - eye @ normal) / (ray @ normal)[..., None] * ray


def clip_space(view, size, y_up):
    """The matrix (4, 4) from the world to clip space, for row vectors."""
    u, v, w = view.K @ np.linalg.inv(view.camera_to_world)[:3]
    height, width = size
    y = 2 / height * v - w
    return np.stack([2 / width * u - w, -y if y_up else y, w, w]).T


def images(index, size=SIZE):
    """Irradiance, albedo and a reference."""
    rng = np.random.default_rng(index)
    irradiance, albedo = rng.exponential(1, (*size, 3)), rng.uniform(0.1, 1, (*size, 3))
    return irradiance, albedo, albedo


def write_exr(path, image):
    planes = {name: np.ascontiguousarray(image[..., i], np.float32) for i, name in enumerate("RGB")}
    with OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, planes) as file:
        file.write(str(path))


@pytest.fixture
def bmfr(tmp_path):
    folder = tmp_path / "files" / "sponza" / "inputs"
    folder.mkdir(parents=True)
    matrices = []
    for index in range(FRAMES):
        irradiance, albedo, reference = images(index)
        normal = np.broadcast_to(np.array([-0.25, 0.0, 1.0]) / np.hypot(0.25, 1), (*SIZE, 3)).copy()
        normal[:4] = 0  # background
        named = {"color": irradiance, "albedo": albedo, "reference": reference, "shading_normal": normal}
        for name, image in (named | {"world_position": positions(view(index))}).items():
            write_exr(folder / f"{name}{index}.exr", image)
        rows = clip_space(view(index), SIZE, y_up=False)
        lines = ",\n".join("      {" + ", ".join(f"{x:.9e}f" for x in row) + "}" for row in rows)
        matrices.append(f"   {{ // frame {index}\n{lines}\n   }}")
    text = f"const float position_limit_squared = 0.01f;\nconst float camera_matrices[{FRAMES}][4][4] = {{\n"
    offsets = "const float pixel_offsets[1][2] = {\n   {0.500000, 0.500000}, // frame 0\n};\n"
    (folder / "camera_matrices.h").write_text(text + ",\n".join(matrices) + "\n};\n" + offsets)
    return tmp_path / "files"


def test_bmfr_files_keep_cameras_light_and_motion(bmfr, tmp_path):
    assert import_bmfr(bmfr, tmp_path / "data") == 1
    assert import_bmfr(bmfr, tmp_path / "data") == 0  # it is there
    (clip,) = Dataset(tmp_path / "data").clips("test")
    assert (clip.scene, clip.frames, clip.height, clip.width) == ("sponza", FRAMES, *SIZE)
    for index in range(FRAMES):
        wanted = view(index)
        irradiance, albedo, reference = images(index)
        assert np.allclose(clip.view(index).K, wanted.K, atol=1e-3)
        assert np.allclose(clip.view(index).camera_to_world, wanted.camera_to_world, atol=1e-5)
        assert np.allclose(clip.noisy(index)[4:], (irradiance * albedo)[4:], rtol=2e-3, atol=1e-4)
        assert np.allclose(clip.reference(index).mean(axis=0), reference, rtol=2e-3, atol=5e-3)  # of background, too
        assert np.allclose(clip.read("depth", index)[4:, :, 0], depth_of(wanted)[4:], rtol=1e-5)
        assert (clip.read("mesh_id", index)[:4] == 0).all() and (clip.read("mesh_id", index)[4:] == 1).all()
        before = view(max(index - 1, 0))
        motion = motion_vectors(pixel_centres(*SIZE), depth_of(wanted), np.ones(SIZE, int), wanted, before)
        assert np.allclose(clip.read("motion", index)[4:], motion[4:], atol=1e-3)


def depth_of(view):
    """Along the viewing axis."""
    to_camera = np.linalg.inv(view.camera_to_world)
    return positions(view) @ to_camera[2, :3] + to_camera[2, 3]


def test_imported_clips_can_be_denoised_with_history(bmfr, tmp_path):
    import_bmfr(bmfr, tmp_path / "data")
    clip = Clip(tmp_path / "data" / "test" / "sponza" / "000")
    denoiser, state = create("accumulated"), None
    for index in range(FRAMES):
        _, state = denoiser(read_frame(clip, index, denoiser.reads), state)
    assert state.pictures()["history length"][0, 0, 20:-20, 20:-20].min() == FRAMES


def test_pictures_show_the_reference_of_the_background(bmfr, tmp_path):
    import_bmfr(bmfr, tmp_path / "data")
    (clip,) = Dataset(tmp_path / "data").clips("test")
    _, (panel,) = view_clip(clip, {"noisy": create("noisy")}, [0])
    assert np.allclose(panel.image, display(images(0)[2], clip.exposure), atol=0.02)


def test_another_dataset_is_not_overwritten(bmfr, tmp_path):
    import_bmfr(bmfr, tmp_path / "data")
    before = (tmp_path / "data" / "dataset.json").read_bytes()
    with pytest.raises(BadInput, match="something other than these clips"):
        write_dataset(tmp_path / "data", "noisebase at 2 spp", {}, 2)
    assert (tmp_path / "data" / "dataset.json").read_bytes() == before


def test_what_needs_a_scene_says_so_and_the_rest_works(bmfr, tmp_path):
    import_bmfr(bmfr, tmp_path / "data")
    dataset = Dataset(tmp_path / "data")
    assert "profile bmfr" in summarise(tmp_path / "data")
    with pytest.raises(BadInput, match="was imported: only datasets that onespp rendered have a card"):
        export_dataset(tmp_path / "data", tmp_path / "oidn")
    with pytest.raises(BadInput, match="was rendered by another version"):
        scene_of(dataset.clips("test")[0], dataset)


def test_what_one_reference_of_total_light_cannot_tell_is_refused(bmfr, tmp_path):
    import_bmfr(bmfr, tmp_path / "data")
    (clip,) = Dataset(tmp_path / "data").clips("test")
    assert clip.is_imported
    assert "unknown" in summarise(tmp_path / "data")  # the noise floor
    for read in (lambda: clip.reference(0, "indirect"), lambda: next(onespp.read_frames(clip, create("ntd")))):
        with pytest.raises(BadInput, match="sponza/000 was imported and has no indirect light"):
            read()
    assert next(onespp.read_frames(clip, create("ntd", "total"))).radiance("total").max() > 0


def test_scenes_of_one_name_are_refused(bmfr, tmp_path):
    shutil.copytree(bmfr / "sponza", bmfr / "again" / "sponza")
    with pytest.raises(BadInput, match=r"again.* and .*sponza.* have the same name"):
        import_bmfr(bmfr, tmp_path / "data")


def test_a_scene_without_frames_or_with_a_singular_camera_is_refused(bmfr, tmp_path):
    folder = bmfr / "sponza" / "inputs"
    zeros = ", ".join(["{0.0, 0.0, 0.0, 0.0}"] * 4)
    (folder / "camera_matrices.h").write_text(f"const float camera_matrices[1][4][4] = {{ {{ {zeros} }} }};")
    with pytest.raises(BadInput, match=r"camera_matrices\.h has a singular"):
        import_bmfr(bmfr, tmp_path / "data")
    (folder / "color0.exr").unlink()
    with pytest.raises(BadInput, match=r"color0\.exr is missing"):
        import_bmfr(bmfr, tmp_path / "data")


def test_bmfr_files_of_another_size_and_damaged_matrices_are_named(bmfr, tmp_path):
    folder = bmfr / "sponza" / "inputs"
    shutil.move(folder / "albedo1.exr", tmp_path)
    write_exr(folder / "albedo1.exr", np.ones((8, 8, 3)))
    with pytest.raises(BadInput, match=r"albedo1\.exr has an image that is not 96x72"):
        import_bmfr(bmfr, tmp_path / "data")
    shutil.move(tmp_path / "albedo1.exr", folder / "albedo1.exr")
    for path in folder.glob("*2.exr"):
        write_exr(path, np.ones((8, 8, 3)))
    with pytest.raises(BadInput, match=r"color2\.exr has an image that is not 96x72"):
        import_bmfr(bmfr, tmp_path / "data")
    matrices = folder / "camera_matrices.h"
    head, brace, numbers = matrices.read_bytes().rpartition(b"f}")
    matrices.write_bytes(head[:-1] + b"\xff" + brace + numbers)
    with pytest.raises(BadInput, match=r"camera_matrices\.h has no 4 x 4 matrices"):
        import_bmfr(bmfr, tmp_path / "data")


@pytest.mark.parametrize("share", [0.01, 0.5])
def test_damaged_bmfr_files_are_named(bmfr, tmp_path, capfd, share):
    broken = bmfr / "sponza" / "inputs" / "albedo1.exr"
    whole = broken.read_bytes()
    broken.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(BadInput, match=r"albedo1\.exr is damaged"):
        import_bmfr(bmfr, tmp_path / "data")
    written = capfd.readouterr()
    assert "EXR_ERR" not in written.err and "Warning" not in written.out + written.err  # the library's
    assert not (tmp_path / "data" / "test" / "sponza" / "000").exists()
    with pytest.raises(BadInput, match="has no scene"):
        import_bmfr(tmp_path / "data", tmp_path / "other")


def encoded(radiance):
    """RGBE (4, H, W, S) of radiance, and its range, by the format's description."""
    brightest = radiance.max(axis=0)
    low, high = np.log(radiance[radiance > 0].min()), np.log(brightest.max())
    exponent = np.clip(np.floor((np.log(brightest) - low) / (high - low) * 256), 0, 255)
    scale = np.exp(low + (exponent + 1) / 256 * (high - low))
    return np.concatenate([np.round(radiance / scale * 255), exponent[None]]).astype("u1"), np.float32([low, high])


def write_noisebase(folder, size, moved=(0.0, 0.0, 0.0)):
    """Frames in which all surfaces have come from where `moved` leads in the world."""
    zarr = pytest.importorskip("zarr")
    folder.mkdir(parents=True)
    for index in range(FRAMES):
        here = view(index, size)
        samples = [np.moveaxis(images(10 * index + sample, size)[0], -1, 0) for sample in (0, 1)]
        color, exposure = encoded(np.stack(samples, axis=-1))
        surfaces = positions(here, size), images(index, size)[1]
        flat = [np.moveaxis(image, -1, 0)[..., None].repeat(2, axis=-1) for image in surfaces]
        normal = np.broadcast_to(np.float16([0, 0, 1]).reshape(3, 1, 1, 1), (3, *size, 2))
        arrays = {
            "color": color,
            "exposure": exposure,
            "reference": np.moveaxis(images(index, size)[2], -1, 0).astype("f4"),
            "position": flat[0].astype("f4"),
            "motion": np.broadcast_to(np.float32(moved).reshape(3, 1, 1, 1), (3, *size, 2)),
            "normal": normal,
            "diffuse": flat[1].astype("f2"),
            "view_proj_mat": clip_space(here, size, y_up=True).astype("f4"),
        }
        with zarr.storage.ZipStore(folder / f"frame{index:04d}.zip", mode="w") as store:
            group = zarr.create_group(store, zarr_format=2)
            for name, array in arrays.items():
                group.create_array(name, data=np.ascontiguousarray(array))


@pytest.fixture
def noisebase(tmp_path):
    write_noisebase(tmp_path / "files" / "bistro1", (SIZE[0] + 2 * CROPPED_ROWS, SIZE[1]))
    return tmp_path / "files"


def test_noisebase_files_keep_cameras_light_and_motion(noisebase, tmp_path):
    assert import_noisebase(noisebase, tmp_path / "data", samples=2) == 1
    (clip,) = Dataset(tmp_path / "data").clips("test")
    size = SIZE[0] + 2 * CROPPED_ROWS, SIZE[1]
    rows = slice(CROPPED_ROWS, size[0] - CROPPED_ROWS)
    assert (clip.scene, clip.height, clip.width, clip.facts["noisy_spp"]) == ("bistro1", *SIZE, 2)
    for index in range(FRAMES):
        wanted = view(index, size)
        samples = [images(10 * index + sample, size)[0] for sample in (0, 1)]
        assert np.allclose(clip.noisy(index), np.mean(samples, axis=0)[rows], rtol=0.02, atol=0.01)
        assert np.allclose(clip.view(index).camera_to_world, wanted.camera_to_world, atol=1e-4)
        assert np.allclose(clip.view(index).K[:2, 2], wanted.K[:2, 2] - [0, CROPPED_ROWS], atol=0.01)
        point = positions(wanted, size)[rows][30, 40]
        u, v, w = clip.view(index).K @ (np.linalg.inv(clip.view(index).camera_to_world)[:3] @ [*point, 1])
        assert np.allclose([u / w, v / w], [40.5, 30.5], atol=0.01)
        assert w == pytest.approx(float(clip.read("depth", index)[30, 40, 0]), rel=1e-4)
        if index:
            pixels = pixel_centres(*size)
            to_camera = np.linalg.inv(wanted.camera_to_world)
            depth = positions(wanted, size) @ to_camera[2, :3] + to_camera[2, 3]
            motion = motion_vectors(pixels, depth, np.ones(size, int), wanted, view(index - 1, size))[rows]
            assert np.allclose(clip.read("motion", index), motion, atol=0.01)


def test_noisebase_files_keep_the_motion_of_things(tmp_path):
    """Along the axis of the camera's slide, three times as fast: what the pixel shows was to the left of it."""
    zeros = np.zeros(3)
    moved = np.array([-0.3, 0.0, 0.0])
    size = SIZE[0] + 2 * CROPPED_ROWS, SIZE[1]
    for name, motion in (("still", zeros), ("moving", moved)):
        write_noisebase(tmp_path / "files" / name, size, motion)
    import_noisebase(tmp_path / "files", tmp_path / "data", samples=1)
    moving, still = Dataset(tmp_path / "data").clips("test")
    now, before = view(1, size), view(0, size)
    point = positions(now, size)[CROPPED_ROWS + 30, 40]

    def pixel(point, view):
        u, v, w = view.K @ (np.linalg.inv(view.camera_to_world)[:3] @ [*point, 1])
        return np.array([u / w, v / w])

    assert np.abs(moving.read("motion", 0)).max() < 1e-3  # without a frame before
    for clip, motion in ((still, zeros), (moving, moved)):
        found = clip.read("motion", 1)[30, 40]
        assert np.allclose(found, pixel(point + motion, before) - pixel(point, now), atol=0.01)
    assert abs(moving.read("motion", 1)[30, 40, 0] - still.read("motion", 1)[30, 40, 0]) > 1


def test_noisebase_frames_are_those_with_numbers_and_none_is_missing(noisebase, tmp_path):
    folder = noisebase / "bistro1"
    shutil.copy(folder / "frame0001.zip", folder / "frame0001 (1).zip")
    import_noisebase(noisebase, tmp_path / "data", samples=1)
    assert Dataset(tmp_path / "data").clips("test")[0].frames == FRAMES
    shutil.copy(folder / "frame0001.zip", folder / "frame0005.zip")
    with pytest.raises(BadInput, match=r"frame0003\.zip is missing"):
        import_noisebase(noisebase, tmp_path / "other", samples=1)
    write_noisebase(tmp_path / "small", (80, 64))
    shutil.move(tmp_path / "small" / "frame0002.zip", folder / "frame0002.zip")
    (folder / "frame0005.zip").unlink()
    with pytest.raises(BadInput, match=r"frame0002\.zip has an image that is not 96x128"):
        import_noisebase(noisebase, tmp_path / "other", samples=1)


def test_noisebase_files_with_too_few_samples_are_refused(noisebase, tmp_path):
    with pytest.raises(BadInput, match="has 2 samples per pixel, not 4"):
        import_noisebase(noisebase, tmp_path / "data", samples=4)
    with pytest.raises(BadInput, match="has no sequence"):
        import_noisebase(tmp_path / "data", tmp_path / "other", samples=1)


@pytest.mark.parametrize(("files", "spp"), [("noisebase", 0), ("noisebase", -1), ("bmfr", 8)])
def test_sample_counts_that_do_not_apply_are_refused(tmp_path, capsys, files, spp):
    assert "--spp" in fails(capsys, "import", files, str(tmp_path), "--data", str(tmp_path / "data"), "--spp", str(spp))
    assert not (tmp_path / "data").exists()


def test_noisebase_files_without_any_row_left_are_refused(tmp_path):
    write_noisebase(tmp_path / "files" / "small", (2 * CROPPED_ROWS, 64))
    with pytest.raises(BadInput, match=r"frame0000\.zip has 56 rows"):
        import_noisebase(tmp_path / "files", tmp_path / "data", samples=1)
