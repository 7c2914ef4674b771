"""The command line: one thin function per subcommand."""

import errno
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from shutil import get_terminal_size
from textwrap import wrap
from typing import Annotated, Literal

import tyro
from tyro.conf import FlagCreatePairsOff, Positional, arg

from denoise.job import Job
from errors import BadInput
from process import set_up_process

Data = Annotated[Path | None, arg(metavar="DIR", help="the dataset; by default data/PROFILE")]
RenderedData = Annotated[Path, arg(metavar="DIR", help="the dataset")]
DataOfBudget = Annotated[Path | None, arg(metavar="DIR", help="the dataset; by default data/BUDGET")]
Device = Annotated[Literal["cpu", "cuda"], arg(help="where to compute")]
Runs = Annotated[Path, arg(metavar="DIR", help="folder of trainings and results")]
Profile = Annotated[
    str,
    arg(
        metavar="{tiny,quick,release,release-256,furnished,furnished-192,benchmark,glass,rooms-NxS}",
        help="which clips (docs/data.md): tiny takes seconds, quick minutes, release days; furnished needs --models; "
        "rooms-NxS: N small rooms, with references of S spp",
    ),
]
Budget = Annotated[
    str,
    arg(
        metavar="{tiny,quick,release,furnished,paper}",
        help="how long networks are trained; the weights are in RUNS/train/NAME-BUDGET",
    ),
]
Denoisers = Annotated[tuple[str, ...], Positional, arg(metavar="[DENOISER...]", help="their names (docs/denoisers.md)")]
Scenes = Annotated[
    tuple[str, ...], Positional, arg(metavar="[SCENE...]", help="such as cornell_box, room-3 or my-scene.toml")
]
Size = Annotated[str, arg(metavar="WxH", help="size of the images")]
Threads = Annotated[int | None, arg(metavar="N", help="by default as many as PyTorch uses")]
Flag = Annotated[bool, FlagCreatePairsOff]
Models = Annotated[
    Path | None,
    arg(metavar="DIR", help="furnish rooms (of datasets, those to train on) from its *.sh3f (docs/data.md)"),
]
Seed = Annotated[int, arg(help="of scenes, flights and noise")]
Png = Annotated[Path, arg(metavar="PNG", help="the image to write")]
RUNS = Path("runs")
DEFAULT_SPP = (1, 2, 4, 8, 16, 32, 64, 128, 256)


def data_folder(data: Path | None, name: str) -> Path:
    return data or Path("data") / name


def preview(
    names: Scenes = (),
    out: Png = RUNS / "preview.png",
    seed: Seed = 0,
    spp: Annotated[int, arg(help="samples per pixel")] = 64,
    models: Models = None,
) -> None:
    """Draw a contact sheet of scenes, by default of 16 rooms: the middle frame of each."""
    from eval.figures.contact_sheet import contact_sheet

    out.parent.mkdir(parents=True, exist_ok=True)
    rooms = [f"{'furnished-' if models else ''}room-{number}" for number in range(16)]
    contact_sheet(out, names or rooms, seed, spp=spp, models=models)
    print(out)


def dataset(
    data: Data = None,
    profile: Profile = "quick",
    scene: Annotated[Path | None, arg(metavar="TOML")] = None,
    seed: Seed = 0,
    reads: Annotated[tuple[str, ...], arg(metavar="DENOISER...")] = (),
    part: Annotated[str, arg(metavar="K/N")] = "1/1",
    models: Models = None,
    halton: Flag = False,
    regularise: Flag = False,
) -> None:
    """Render the missing clips of a profile, or of your own scene.

    Args:
        scene: your own scene instead of a profile (docs/scenes.md). Unsupported features of its file are listed first.
        reads: store in training clips only what these denoisers read; by default all networks that can be trained.
        part: render only the K-th of N disjoint shares, to distribute the work.
        halton: sample noisy frames from 16 Halton points with a per-pixel shift (SVGF, RAE).
        regularise: roughen glossy materials after the first bounce (RAE): fewer fireflies, softer caustics.
    """
    from models.registry import channels_read
    from render.clip import Options
    from render.job.generate import generate
    from train.recipes import TRAINABLE

    folder = data_folder(data, scene.stem if scene else profile)
    source = str(scene.resolve()) if scene else profile
    channels = channels_read(reads or TRAINABLE)
    furniture = str(models.resolve()) if models else ""
    rendered = generate(folder, source, seed, part, channels, Options(halton, regularise), furniture)
    print(f"{folder}: {rendered} clips rendered")


def train(
    names: Denoisers = (),
    data: DataOfBudget = None,
    runs: Runs = RUNS,
    budget: Budget = "quick",
    seed: Annotated[int, arg(help="of first weights and of the order of the data")] = 0,
    precision: Annotated[Literal["float32", "bfloat16"] | None, arg(metavar="{float32,bfloat16}")] = None,
    micro_batch: Annotated[int | None, arg(metavar="N")] = None,
    from_: Annotated[str | None, arg(name="from", metavar="weights|FILE")] = None,
    specialise: Flag = False,
) -> None:
    """Train networks, or resume: by default wskp6 for quick, one for furnished, else rae, wskp6 and ntd-mean.

    On several GPUs or machines with a common RUNS: `torchrun --nproc-per-node N -m onespp train ...`. Every batch is
    shared by all processes, so the steps are the same.

    Args:
        precision: by default the fastest on this machine.
        micro_batch: process this many sequences or crops of a batch at a time, to save memory (gradient accumulation).
        from_: fine-tune these weights of the same network, "weights" meaning the shipped ones; use another --runs.
        specialise: remove network inputs that are constant in this dataset, such as a white albedo.
    """
    from models.registry import require_shipped
    from train.loop import train_network
    from train.recipes import task_for, trained_by_default

    folder = data_folder(data, budget)
    file = Path(from_) if from_ else None
    for name in names or trained_by_default(budget):
        start = require_shipped(name) if from_ == "weights" else file
        task = replace(task_for(name, folder, runs, budget), seed=seed, precision=precision, start=start)
        train_network(replace(task, micro_batch=micro_batch, specialised=specialise))


def evaluate(
    names: Denoisers = (),
    data: Annotated[tuple[Path, ...], arg(metavar="DIR...", help="datasets; by default data/BUDGET")] = (),
    runs: Runs = RUNS,
    budget: Budget = "quick",
    processes: Annotated[int, arg(metavar="N", help="clips to evaluate in parallel, at most")] = os.cpu_count() or 1,
    device: Device = "cpu",
    first_hits: Annotated[bool, arg(help="describe mirrors and glass by themselves, not by what they show")] = False,
    where: Annotated[bool, arg(help="print where the squared error is instead: edges, roughness, scale")] = False,
    jod: Annotated[bool, arg(help="also print JOD by ColorVideoVDP, which the extra `cvvdp` installs")] = False,
) -> None:
    """Evaluate denoisers on the test clips, by default all that can run: table, images, results.json.

    Networks use their shipped weights (`onespp weights`) and, as NETWORK@BUDGET, those trained in this budget. Earlier
    results of the same clips, weights and code are kept.
    """
    from eval.error_location import where as error_tables
    from eval.harness import evaluate as evaluate_on

    if where and jod:
        raise BadInput("--where prints other tables and stores no pictures for --jod: leave one of them out")
    folders = data or [data_folder(None, budget)]
    if where:
        print(error_tables(folders, runs, budget, names, device, first_hits))
    else:
        evaluate_on(folders, runs, budget, names, processes, device, first_hits)
        if jod:
            from eval.jod import jod_table

            print(jod_table(runs))


def report(
    runs: Runs = RUNS,
    megabytes: Annotated[float, arg(help="size of all images; where not all frames fit, every n-th is shown")] = 24,
) -> None:
    """Write a self-contained page of all results, RUNS/report/index.html, and an animation of each clip.

    Where Clang for WebAssembly is installed, it links to a page that denoises a clip in the browser.
    """
    from eval.report.page import report as make_report

    page, *beside_it = make_report(runs, megabytes)
    for path in beside_it:
        print(path)
    print(f"open {page} in a browser")


def info(data: RenderedData = Path("data/quick")) -> None:
    """Print the contents of a dataset: clips, channels, sizes, noise floors, render times."""
    from datasets.info import summarise

    print(summarise(data))


def verify(data: RenderedData = Path("data/quick")) -> None:
    """Check every file of a dataset against its checksum and shape."""
    from datasets.info import find_problems

    if problems := find_problems(data):
        print(*problems, sep="\n")
        raise BadInput(f"{data}: {len(problems)} problems; delete the clips named above and rerun `onespp dataset`")
    print(f"{data}: all files are intact")


def exr(
    source: Annotated[
        Path, Positional, arg(metavar="CLIP|DATA", help="the folder of a clip, or for oidn of a dataset")
    ],
    out: Annotated[Path, Positional, arg(metavar="OUT", help="the folder to write")],
    layout: Literal["frames", "oidn"] = "frames",
) -> None:
    """Write OpenEXR files: a multi-layer file per frame of a clip, or, resumable, a dataset for OIDN's trainer.

    Args:
        layout: "frames" takes a clip, such as data/quick/test/cornell_box/000; "oidn" takes a dataset and
            writes OUT/train, OUT/valid and OUT/test for the preprocess.py of Intel Open Image Denoise.
    """
    from datasets.exr import export_clip
    from datasets.oidn_layout import export_dataset

    if layout == "oidn":
        print(f"{out}: {export_dataset(source, out)} noisy images with their references")
    else:
        print(f"{out}: {export_clip(source, out)} files")


def show(
    clip: Annotated[Path, Positional, arg(metavar="CLIP", help="the clip's folder")],
    names: Denoisers = (),
    out: Annotated[Path, arg(metavar="DIR", help="where to write the pictures")] = RUNS / "show",
    runs: Runs = RUNS,
    budget: Budget = "quick",
) -> None:
    """Draw a clip as denoised by those named, or by all that can run.

    A contact sheet with errors, difference maps, and each denoiser's state.
    """
    from eval.figures.show import show as draw

    print(*draw(clip, out, runs, budget, names), sep="\n")


def export(
    name: Annotated[
        str, Positional, arg(metavar="DENOISER", help="wskp3, wskp6 or one; NAME@BUDGET for weights in RUNS")
    ],
    to: Annotated[Literal["onnx", "pt2"], arg(help="ONNX, or a file for torch.export.load")] = "onnx",
    out: Annotated[Path | None, arg(metavar="DIR", help="by default RUNS/export/DENOISER-TO")] = None,
    runs: Runs = RUNS,
    weights: Annotated[Path | None, arg(metavar="FILE", help="by default the shipped ones")] = None,
    precision: Annotated[Literal["float32", "float16"], arg(help="of the network")] = "float32",
    warp: Annotated[
        Literal["inside", "outside"], arg(help="whether the file reprojects its history itself")
    ] = "inside",
) -> None:
    """Write a trained denoiser as one ONNX or pt2 file, with a manifest, golden frames and calling instructions."""
    from eval.export import export as write

    print(write(name, to, runs, weights, precision, warp, out))


def bench_denoisers(
    names: Denoisers = (),
    runs: Runs = RUNS,
    size: Annotated[tuple[str, ...], arg(metavar="WxH...", help="size of the images")] = ("1280x720",),
    threads: Annotated[tuple[int, ...], arg(metavar="N...", help="by default as many as PyTorch uses")] = (),
    every_way: Annotated[
        Flag, arg(name="all", help="also other precisions, PyTorch without kernels, one thread")
    ] = False,
) -> None:
    """Measure milliseconds and memory per frame beside OIDN, by default of all denoisers as `onespp eval` runs them.

    Where there is a GPU, also on it, without OIDN, which computes on the CPU.
    """
    from eval.bench.denoisers import bench_denoisers as bench

    print(bench(runs, names, size, threads, every_way=every_way))


def bench_light(names: Denoisers = (), runs: Runs = RUNS, budget: Budget = "quick") -> None:
    """Measure how many frames the output lags after a light changes, by default of all denoisers that can run.

    Renders four clips of the Cornell box in a few minutes; table, plot and results.json in RUNS/bench/light.
    """
    from eval.bench.light import bench_light as bench

    print(bench(runs, names, budget))


def stress(
    names: Denoisers = (),
    runs: Runs = RUNS,
    budget: Budget = "quick",
    long: Annotated[Flag, arg(help="also run sequences of 10 000 frames (minutes)")] = False,
    precision: Annotated[Literal["float32", "bfloat16", "float16"], arg(help="of networks")] = "float32",
) -> None:
    """Run denoisers on extreme input, by default all that can run: tables, results.json, a heat map.

    Networks use their shipped weights, else those trained in this budget, else random ones. Exits with 1 if a
    requirement is broken.
    """
    from eval.stress.run import stress as run_stress

    if not run_stress(runs, names, budget, long, precision):
        sys.exit(1)


def trade(
    names: Denoisers = (),
    data: DataOfBudget = None,
    runs: Runs = RUNS,
    budget: Budget = "quick",
    size: Annotated[str | None, arg(metavar="WxH", help="use times at this size; by default the clips'")] = None,
    threads: Annotated[int | None, arg(metavar="N", help="use times with so many; by default the most")] = None,
    spp: Annotated[tuple[int, ...], arg(metavar="N...", help="samples per pixel, rising")] = DEFAULT_SPP,
) -> None:
    """Compare quality with milliseconds, by denoiser, precision and samples per pixel: tables, a plot, trade.json.

    Evaluates denoisers on the test clips, by default all that can run. Run `onespp bench denoisers` first for times.
    """
    from eval.tradeoff.run import trade as compare

    print(compare(data_folder(data, budget), runs, budget, spp, names, size, threads))


def denoise(job: Annotated[Job, arg(name="")], runs: Runs = RUNS, threads: Threads = None) -> None:
    """Denoise OpenEXR sequences of any renderer, or resume.

    Layers are recognised by common names, the motion vectors' convention by trial; both are printed first.
    """
    from denoise.run import denoise as denoise_sequence
    from eval.bench.denoisers import thread_counts
    from eval.selection import weights_of
    from models.registry import parse_name
    from timing import thread_count

    weights = job.weights or weights_of(parse_name(job.denoiser), runs)
    with thread_count(thread_counts(() if threads is None else (threads,))[-1]):
        denoise_sequence(replace(job, weights=weights))


def relight(
    frames: Annotated[tuple[str, ...], Positional, arg(metavar="PATTERN...")],
    lights: Annotated[tuple[str, ...], arg(metavar="LAYER...")],
    out: Annotated[Path, arg(metavar="PAGE", help="the page to write")] = Path("relight.html"),
    frame_range: Annotated[str | None, arg(name="frames", metavar="A-B")] = None,
) -> None:
    """Write a page that dims and tints the denoised lights of a sequence: one file that works offline.

    Args:
        frames: files that `onespp denoise --aov LAYER...` has written.
        lights: the layers of lights, which add up to the picture.
        frame_range: frame numbers to show.
    """
    from denoise.relight import write_relight_page

    write_relight_page(frames, lights, out, frame_range)
    print(out)


def weights(
    name: Annotated[str | None, Positional, arg(metavar="[NETWORK]", help="show the card of this network")] = None,
    card: Annotated[Path | None, arg(metavar="RUNS")] = None,
    average: Annotated[tuple[Path, ...], arg(metavar="FILE...", help="weights of NETWORK to average")] = (),
    out: Annotated[Path | None, arg(metavar="FILE", help="where to write their mean")] = None,
) -> None:
    """List the networks with shipped weights, show the card of one, or average the weights of trainings.

    Args:
        card: rewrite the measurements and facts of the card, or of all cards, from the weights and RUNS/eval.
    """
    from eval.shipped import card_file, measure_card, table
    from models.registry import create, shipped_names
    from models.weights import average_weights

    if average and card:
        raise BadInput("--average writes weights and --card the card of shipped ones: leave one of them out")
    if average and name and out:
        average_weights(create(name), name, average, out)
        print(out)
    elif average or out:
        raise BadInput("--average FILE... needs the NETWORK and --out FILE, and --out needs --average")
    elif card:
        for each in [name] if name else shipped_names():
            print(measure_card(each, card))
    else:
        print(card_file(name).read_text().strip() if name else table())


def import_(
    files: Annotated[Literal["bmfr", "noisebase"], Positional, arg(help="whose files")],
    source: Annotated[Path, Positional, arg(metavar="DIR", help="their folder")],
    data: Annotated[Path | None, arg(metavar="DIR", help="the dataset; by default data/bmfr and so on")] = None,
    spp: Annotated[int | None, arg(help="samples per pixel to use of Noisebase's; by default 2")] = None,
) -> None:
    """Make a dataset of the frames of BMFR (Koskela et al. 2019) or of Noisebase (Balint et al. 2023)."""
    from datasets.bmfr_files import import_bmfr
    from datasets.noisebase_files import import_noisebase

    if files == "bmfr" and spp is not None:
        raise BadInput("--spp is an option of noisebase: BMFR's frames are of 1 spp")
    folder = data_folder(data, files)
    samples = 2 if spp is None else spp
    clips = import_bmfr(source, folder) if files == "bmfr" else import_noisebase(source, folder, samples)
    print(f"{folder}: {clips} clips")


def benchmark_list(
    scenes: Annotated[
        Path | None, arg(metavar="DIR", help="say which are there, and whether they are those we used")
    ] = None,
    toml: Annotated[
        str | None, arg(metavar="FOLDER", help="print the description of this scene's clip instead")
    ] = None,
) -> None:
    """List the scenes by other people, and ours: author, licence, and how to get them."""
    from eval.benchmark.run import list_scenes, toml_of

    print(toml_of(toml) if toml else list_scenes(scenes))


def benchmark_run(
    names: Annotated[tuple[str, ...], Positional, arg(metavar="[DENOISER...]", help="by default OIDN, svgf, one")] = (),
    scenes: Annotated[Path | None, arg(metavar="DIR", help="the folder that has a folder for each scene")] = None,
    data: Annotated[Path, arg(metavar="DIR", help="where datasets are rendered")] = Path("data/benchmark"),
    runs: Runs = RUNS / "benchmark",
    size: Size = "640x360",
    frames: Annotated[int, arg(metavar="N", help="of each clip")] = 49,
    floor: Annotated[float, arg(metavar="DB", help="noise floor of the references")] = 35.0,
    own: Annotated[Flag, arg(help="also five scenes of ours that no training uses")] = False,
) -> None:
    """Render the scenes that are there and evaluate denoisers on them; tables and RUNS/benchmark.json."""
    from eval.bench.denoisers import parse_size
    from eval.benchmark.run import Format
    from eval.benchmark.run import run as run_benchmark

    clips = Format(parse_size(size)[::-1], frames, floor)
    print(run_benchmark(scenes, data, runs, names, clips, own))


def benchmark_published(
    names: Denoisers, data: Annotated[Path, arg(metavar="DIR", help="made by `onespp import`")], runs: Runs = RUNS
) -> None:
    """Score denoisers on other people's data by their own rules, beside the results that they published.

    By default all that can run, networks as for `onespp eval`, with the budget "release".
    """
    from eval.benchmark.published import published

    print(published(names, data, runs, "release"))


def benchmark_page(
    names: Annotated[tuple[str, str], Positional, arg(metavar="A B", help="the two denoisers")],
    data: Annotated[tuple[Path, ...], arg(metavar="DIR...", help="datasets whose test clips are shown")],
    runs: Runs = RUNS,
) -> None:
    """Write a page on which a person compares two unnamed denoisers, clip by clip, and which counts."""
    from eval.benchmark.page import write_page

    print(f"open {write_page(names, data, runs, 'release')} in a browser")


Command = Callable[..., None]
Commands = dict[str, "Command | Commands"]

GROUPS: dict[str, Commands] = {
    "Pipeline": {"preview": preview, "dataset": dataset, "train": train, "eval": evaluate, "report": report},
    "Datasets": {"info": info, "verify": verify, "exr": exr, "import": import_},
    "Your own frames": {"denoise": denoise, "relight": relight, "weights": weights, "export": export},
    "Comparisons": {
        "show": show,
        "trade": trade,
        "stress": stress,
        "bench": {"denoisers": bench_denoisers, "light": bench_light},
        "benchmark": {
            "list": benchmark_list,
            "run": benchmark_run,
            "published": benchmark_published,
            "page": benchmark_page,
        },
    },
}
TITLE = "onespp: from a 3-D scene to a Monte Carlo denoiser you can trust."
MARGIN = 14  # characters left of the summaries
SUMMARIES = {
    "bench": "Measure speed and memory of denoisers, and their lag after a light changes.",
    "benchmark": "Compare denoisers on scenes and data of other people.",
}


def main(arguments: list[str] | None = None) -> None:
    """Run one command.

    Exits with 2 and one line on what the user can correct, 130 when interrupted, 141 where `| head` has read enough.
    """
    words = sys.argv[1:] if arguments is None else arguments
    set_up_process()
    try:
        try:
            run(words)
        finally:
            sys.stdout.flush()
        return
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for what is flushed at exit
        sys.exit(141)
    except BadInput as error:
        code, message = 2, f"onespp: {error}"
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        remedy = "make room" if full else "correct that or choose another folder"
        code, message = 2, f"onespp: {where}{error.strerror or error}; {remedy} and run it again"
    except KeyboardInterrupt:
        code, message = 130, "\ninterrupted; run the same command again to resume"
    print(message, file=sys.stderr)
    sys.exit(code)


def run(words: list[str]) -> None:
    """Call the command that `words` begin with; print an overview where they ask for help."""
    path = "onespp"
    groups = GROUPS
    commands = {name: command for group in GROUPS.values() for name, command in group.items()}
    while words and words[0] not in ("-h", "--help"):
        name, *words = words
        if name not in commands:
            raise BadInput(f"unknown command '{path} {name}'; the commands are {', '.join(commands)}")
        path = f"{path} {name}"
        command = commands[name]
        if not isinstance(command, dict):
            tyro.cli(command, prog=path, args=words)
            return
        commands = command
        groups = {SUMMARIES[name]: command}
    print("\n".join(overview(path, groups)))


def overview(path: str, groups: dict[str, Commands]) -> Iterator[str]:
    """The lines of `--help`: all commands, in groups, a sentence each."""
    if path == "onespp":
        yield f"{TITLE}\n"
    yield f"usage: {path} COMMAND ...\n"
    for title, commands in groups.items():
        yield f"{title}\n"
        for name, command in commands.items():
            summary = SUMMARIES[name] if isinstance(command, dict) else (command.__doc__ or "").partition("\n\n")[0]
            first, *rest = wrap(" ".join(summary.split()), min(100, get_terminal_size().columns - MARGIN))
            yield f"  {name:<{MARGIN - 2}}{first}"
            yield from (f"{'':<{MARGIN}}{line}" for line in rest)
        yield ""
    yield f"`{path} COMMAND --help` shows the options of each."
