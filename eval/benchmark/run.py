"""`onespp benchmark`: renders scenes by other people, evaluates denoisers on them, and writes results to compare."""

import hashlib
import json
import os
import tomllib
from collections.abc import Sequence
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
from eval.selection import evaluated
from eval.tables import PRINTED, means_by_age
from files import write_file, write_json
from models.registry import channels_read
from render.job.generate import generate
from render.job.profiles import JUDGED

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
    """The file of a scene; None where it is not there."""
    return next((path for file in FILES if (path := scenes / name / file).exists()), None)


def list_scenes(scenes: Path | None) -> str:
    """A table of the scenes; with a folder, which of them are in it."""
    rows = []
    for name, entry in entries().items():
        found = ("yes" if scene_file(scenes, name) else "missing") if scenes else ""
        rows.append([name, entry["title"], entry["author"], entry["licence"], found])
    table = tabulate(rows, ["folder", "title", "author", "licence", "there"], disable_numparse=True)
    source = "https://benedikt-bitterli.me/resources (Mitsuba)"
    return f"{table}\n\nEach as FOLDER/scene.xml, from {source}; check the licence there"


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


def description(file: Path, toml: Path, bounces: int | None, clips: Format) -> str:
    """The TOML of a scene: one test clip whose first frame is the file's view."""
    judged = [frame for frame in JUDGED if frame < clips.frames]
    light = f"bounces = {bounces}\n" if bounces else ""
    return (
        f"file = {json.dumps(os.path.relpath(file, toml.parent))}\n"
        f"resolution = {list(clips.size)}\nframes = {clips.frames}\n{light}\n"
        "[splits.train]\nclips = 0\n\n[splits.val]\nclips = 0\n\n"
        f"[splits.test]\nclips = 1\nfloor = {clips.floor}\njudged = {judged}\n"
    )


def render_scenes(scenes: Path, data: Path, clips: Format) -> dict[str, Path]:
    """Render the datasets of all scenes that are there, or resume. Returns their folders by name."""
    folders = {}
    for name, entry in entries().items():
        file = scene_file(scenes, name)
        if file is None:
            print(f"{name}: missing, no {scenes / name / FILES[0]}")
            continue
        toml = data / f"{name}.toml"
        data.mkdir(parents=True, exist_ok=True)
        write_file(toml, description(file.resolve(), toml.resolve(), entry.get("bounces"), clips).encode())
        generate(data / name, str(toml.resolve()), seed=0, reads=channels_read())
        folders[name] = data / name
    return folders


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

    `own` adds our own scenes, which no training uses. Raises BadInput where there is nothing to evaluate.
    """
    folders = render_scenes(scenes, data, clips) if scenes else {}
    if own:
        generate(data / BUILT_IN, BUILT_IN, seed=0, reads=channels_read())
    everything = [*folders.values(), *([data / BUILT_IN] if own else [])]
    if not everything:
        where = f"none of the scenes is in {scenes}" if scenes else "nothing to evaluate: name --scenes DIR or --own"
        raise BadInput(f"{where}; `onespp benchmark list` says where to get scenes")
    names = names or NAMES
    evaluate(everything, runs, BUDGET, names)
    content, results = read_results(runs)
    tested = [clip for folder in everything for clip in Dataset(folder).clips("test")]
    facts = {
        "size": size_name((clips.size[1], clips.size[0])),
        "by_age": {metric: means_by_age(by_signal(results)["total"], metric) for metric in PRINTED},
        "digests": {name: digests_of(scenes / name, folder) for name, folder in folders.items() if scenes},
        "rendered": [rendered(clip) for clip in tested],
        "where": {clip.scene: located(clip, [name for name in LOCATED if name in names], runs) for clip in tested},
    }
    path = runs / FILE
    write_json(path, content | facts)
    return path


def digests_of(scene: Path, dataset: Path) -> dict[str, str]:
    """Digests of a scene's files and of its clip."""
    return {"files": digest_of_folder(scene), "clip": Dataset(dataset).clips("test")[0].fingerprint}
