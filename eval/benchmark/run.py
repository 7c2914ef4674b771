"""`onespp benchmark`: renders scenes by other people, evaluates denoisers on them, and writes results to compare."""

import hashlib
import json
import os
import tomllib
from collections.abc import Sequence
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

from tabulate import tabulate

from datasets.clip import Clip, Dataset
from datasets.tonemap import psnr
from errors import BadInput
from eval.bench.denoisers import size_name
from eval.error_location import error_shares
from eval.harness import evaluate
from eval.results import by_signal, read_results
from eval.selection import cannot_run, choose, evaluated, untrained
from eval.tables import PRINTED, means_by_age
from files import crc32_of, write_file, write_json
from models.registry import channels_read, parse_name
from render.job.generate import generate
from render.job.profiles import BENCHMARK_SCENES, DATA_PROFILES, JUDGED

NAMES = (
    *("noisy", "svgf", "oidn", "oidn-balanced", "oidn-fast"),
    *("oidn+accumulated", "oidn+accumulated+adaptive", "one"),
)
FILES = ("scene.xml", "scene_v3.xml")
BUILT_IN = "benchmark"  # the profile of our own scenes
BUDGET = "release"
LOCATED = ("oidn", "one")  # whose errors are located
FILE = "benchmark.json"


def entries() -> dict[str, dict[str, Any]]:
    """The scenes by name, as their folders are called."""
    return tomllib.loads(resources.files("eval.benchmark").joinpath("scenes.toml").read_text())


def scene_file(scenes: Path, name: str) -> Path | None:
    """The file of a scene, whose folder may also have `_` for `-` in its name; None where it is not there."""
    folders = dict.fromkeys((name, name.replace("-", "_")))
    return next((path for folder in folders for file in FILES if (path := scenes / folder / file).exists()), None)


def same_file(name: str, file: Path) -> str:
    """Whether a scene's file is the one of our results, in words; "" for scenes of which we have none."""
    known = entries()[name].get("crc32")
    if known is None:
        return ""
    found = crc32_of(file)
    return "the scene.xml of our results" if found == known else f"another scene.xml than that of our results ({found})"


def presence(scenes: Path, name: str) -> str:
    """Whether a scene is there, and whether its file is the one of our results."""
    file = scene_file(scenes, name)
    return "missing" if file is None else same_file(name, file) or "yes"


OTHER_SCENES = f"""\
Each as FOLDER/scene.xml, from https://benedikt-bitterli.me/resources (Mitsuba); check the licence there.
`onespp benchmark list --toml FOLDER` prints what is rendered of it.
In our results the bathroom has a spherical lamp added; veach-ajar and glass-of-water lack a few meshes.

Ours, which no training uses: {", ".join(BENCHMARK_SCENES)}: `onespp benchmark run --own`
Six scenes of glass: `onespp dataset --profile glass`, then `onespp eval NAME... --data data/glass`
A room rendered by Blender's Cycles (tests/blender/render_room.py): `make blender`, then `make test-all`"""


def list_scenes(scenes: Path | None) -> str:
    """A table of the scenes, and how to get others; with a folder, which are there and whether they are the same."""
    rows = [
        [name, *(entry[key] for key in ("title", "author", "licence")), entry.get("crc32", "")]
        + ([presence(scenes, name)] if scenes else [])
        for name, entry in entries().items()
    ]
    head = ["folder", "title", "author", "licence", "crc32", *(["there"] if scenes else [])]
    return f"{tabulate(rows, head, disable_numparse=True)}\n\n{OTHER_SCENES}"


def digest_of_folder(folder: Path) -> str:
    """A digest of all files of a scene."""
    sums = hashlib.sha256()
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        sums.update(str(path.relative_to(folder)).encode() + hashlib.sha256(path.read_bytes()).digest())
    return sums.hexdigest()[:16]


class Format(NamedTuple):
    """Of the clips: what is rendered of every scene."""

    size: tuple[int, int]  # width, height
    frames: int
    floor: float  # noise floor of the references, PSNR in dB


def own_format() -> Format:
    """That of our own scenes, and by default of all."""
    profile = DATA_PROFILES[BUILT_IN]
    frames, height, width = profile.size
    floor = profile.quality["test"].floor
    assert floor is not None
    return Format((width, height), frames, float(floor))


OWN_FORMAT = own_format()


def description(name: str, file: str, clips: Format) -> str:
    """The TOML of a scene, for its `file` relative to it: one test clip whose first frame is the file's view."""
    judged = [frame for frame in JUDGED if frame < clips.frames]
    bounces = entries()[name].get("bounces")
    light = f"bounces = {bounces}\n" if bounces else ""
    return (
        f"file = {json.dumps(file)}\n"
        f"resolution = {list(clips.size)}\nframes = {clips.frames}\n{light}\n"
        "[splits.train]\nclips = 0\n\n[splits.val]\nclips = 0\n\n"
        f"[splits.test]\nclips = 1\nfloor = {clips.floor}\njudged = {judged}\n"
    )


def toml_of(name: str) -> str:
    """The TOML that `onespp benchmark run` renders a scene by, if put beside its folder. Raises BadInput for others."""
    if name not in entries():
        raise BadInput(f"'{name}' is not one of the scenes: {', '.join(entries())}")
    return description(name, f"{name}/{FILES[0]}", OWN_FORMAT)


def render_scenes(scenes: Path, data: Path, clips: Format) -> dict[str, tuple[Path, Path]]:
    """Render the datasets of all scenes that are there, or resume. Returns their files and datasets by name."""
    done = {}
    for name in entries():
        file = scene_file(scenes, name)
        if file is None:
            print(f"{name}: missing, no {scenes / name / FILES[0]}")
            continue
        if known := same_file(name, file):
            print(f"{name}: {file} is {known}")
        toml = data / f"{name}.toml"
        data.mkdir(parents=True, exist_ok=True)
        relative = os.path.relpath(file.resolve(), toml.resolve().parent)
        write_file(toml, description(name, relative, clips).encode())
        generate(data / name, str(toml.resolve()), seed=0, reads=channels_read())
        done[name] = file, data / name
    return done


def rendered(clip: Clip) -> dict[str, Any]:
    """What a clip's references cost: samples a pixel, their noise floor as PSNR in dB, seconds of rendering in all."""
    return {
        "scene": clip.scene,
        "judged": len(clip.judged),
        "reference_spp": clip.facts["reference_spp"],
        "floor": psnr(clip.facts["floor_mse"]),
        "seconds": sum(clip.seconds.values()),
    }


def located(clip: Clip, names: Sequence[str], runs: Path) -> dict[str, dict[str, dict[str, float]]]:
    """Shares of the pixels and of the squared error by denoiser, question and answer: see `onespp eval --where`."""
    shares: dict[str, dict[str, dict[str, float]]] = {}
    if not names:  # which would stand for all denoisers
        return shares
    for name, values in error_shares(clip, evaluated(names, runs, BUDGET)).items():
        for (question, answer), share in values.items():
            shares.setdefault(name, {}).setdefault(question, {})[answer] = float(share)
    return shares


def run(scenes: Path | None, data: Path, runs: Path, names: Sequence[str], clips: Format, own: bool) -> Path:
    """Render, evaluate and write RUNS/benchmark.json, whose path is returned.

    `own` adds our own scenes, which no training uses. Raises BadInput where there is nothing to evaluate, as
    `onespp eval` for denoisers, and for `clips` that our own scenes do not have.
    """
    if own and clips != OWN_FORMAT:
        size, frames, floor = OWN_FORMAT
        ours = f"our own scenes are {size[0]}x{size[1]}, {frames} frames, to {floor:g} dB"
        raise BadInput(f"{ours}: leave out --size, --frames and --floor")
    obstacles = (cannot_run, partial(untrained, runs, BUDGET))
    chosen = [str(name) for name in choose(names, map(parse_name, NAMES), *obstacles)]  # before what takes hours
    done = render_scenes(scenes, data, clips) if scenes else {}
    if own:
        generate(data / BUILT_IN, BUILT_IN, seed=0, reads=channels_read())
    everything = [*(dataset for _, dataset in done.values()), *([data / BUILT_IN] if own else [])]
    if not everything:
        where = f"none of the scenes is in {scenes}" if scenes else "nothing to evaluate: name --scenes DIR or --own"
        raise BadInput(f"{where}; `onespp benchmark list` says where to get scenes")
    evaluate(everything, runs, BUDGET, chosen)
    content, results = read_results(runs)
    tested = [clip for folder in everything for clip in Dataset(folder).clips("test")]
    total = by_signal(results).get("total", [])  # networks of indirect light alone have none
    facts = {
        "size": size_name((clips.size[1], clips.size[0])),
        "by_age": {metric: means_by_age(total, metric) for metric in PRINTED},
        "digests": {name: digests_of(file, dataset) for name, (file, dataset) in done.items()},
        "rendered": [rendered(clip) for clip in tested],
        "where": {clip.scene: located(clip, [name for name in LOCATED if name in chosen], runs) for clip in tested},
    }
    path = runs / FILE
    write_json(path, content | facts)
    return path


def digests_of(file: Path, dataset: Path) -> dict[str, str]:
    """Digests of a scene's file, of all its files, and of its clip."""
    clip = Dataset(dataset).clips("test")[0]
    return {"crc32": crc32_of(file), "files": digest_of_folder(file.parent), "clip": clip.fingerprint}
