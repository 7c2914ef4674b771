"""The command line: one subcommand a step, each a thin function."""

import errno
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from shutil import get_terminal_size
from textwrap import wrap
from typing import Annotated, Literal

import tyro
from tyro.conf import FlagCreatePairsOff, Positional, arg

from allocator import keep_freed_memory
from errors import BadInput

Data = Annotated[Path | None, arg(metavar="DIR", help="the data set; by default data/PROFILE")]
DataOfBudget = Annotated[Path | None, arg(metavar="DIR", help="the data set; by default data/BUDGET")]
Device = Annotated[Literal["cpu", "cuda"], arg(help="what computes")]
Runs = Annotated[Path, arg(metavar="DIR", help="where trainings and results are kept")]
Profile = Annotated[
    str,
    arg(
        metavar="{tiny,quick,sketch,release,rooms-NxS}",
        help="which clips, how well sampled: seconds, minutes, small rooms, the release (days), "
        "or N small rooms with references of S samples a pixel",
    ),
]
Budget = Annotated[
    str,
    arg(
        metavar="{tiny,quick,release,paper}",
        help="how long networks are trained, as long as their paper at most; names the weights, RUNS/train/NAME-BUDGET",
    ),
]
Denoisers = Annotated[tuple[str, ...], Positional, arg(metavar="DENOISER...", help="by default those named above")]
Scenes = Annotated[
    tuple[str, ...], Positional, arg(metavar="SCENE...", help="such as cornell_box, room-3 or my-scene.toml")
]
ClipFolder = Annotated[Path, Positional, arg(metavar="CLIP", help="its folder")]
Size = Annotated[str, arg(metavar="WxH", help="of the images")]
Sizes = Annotated[tuple[str, ...], arg(metavar="WxH...", help="of the images")]
Png = Annotated[Path, arg(metavar="PNG", help="the picture to write")]
SAMPLES = (1, 2, 4, 8, 16, 32, 64, 128, 256)


def data_folder(data: Path | None, name: str) -> Path:
    return data or Path("data") / name


def preview(names: Scenes = (), out: Png = Path("runs/preview.png"), seed: int = 0, spp: int = 64) -> None:
    """Draw a contact sheet of scenes: the middle frame of each, of 16 rooms unless some are named."""
    from eval.figures.contact_sheet import contact_sheet

    out.parent.mkdir(parents=True, exist_ok=True)
    contact_sheet(out, names or [f"room-{number}" for number in range(16)], seed, spp=spp)
    print(out)


def dataset(
    data: Data = None,
    profile: Profile = "quick",
    scene: Annotated[Path | None, arg(metavar="TOML")] = None,
    seed: int = 0,
    reads: Annotated[tuple[str, ...], arg(metavar="DENOISER...")] = (),
    part: Annotated[str | None, arg(metavar="K/N")] = None,
    ray: Annotated[bool, FlagCreatePairsOff] = False,
    halton: Annotated[bool, FlagCreatePairsOff] = False,
    regularise: Annotated[bool, FlagCreatePairsOff] = False,
) -> None:
    """Render the clips of a profile that are not there yet, or of a scene of your own.

    Args:
        scene: instead of a profile, a scene of your own, as docs/scenes.md describes it. What of its file is not
            honoured is listed first.
        reads: render for training only what these denoisers read, or else all networks that can be trained.
        part: render only the K-th of N disjoint shares, to spread the work over machines.
        ray: render on the Ray cluster of RAY_ADDRESS, or else on all cores of this machine; every machine must reach
            the data set's folder under the same path.
        halton: draw noisy frames from a cycle of 16 Halton points with a shift of each pixel (SVGF, RAE).
        regularise: blur glossy materials after the first bounce (RAE): fewer fireflies, softer caustics.
    """
    from models.registry import channels_read
    from render.clip import Options
    from render.job.generate import Share, generate, render_here
    from train.recipes import TRAINABLE

    if ray:
        from render.job.cluster import render_on_cluster
    folder = data_folder(data, scene.stem if scene else profile)
    share = Share.parse(part or "1/1")
    options = Options(halton, regularise)
    render = render_on_cluster if ray else render_here
    rendered = generate(
        folder,
        str(scene.resolve()) if scene else profile,
        seed,
        share,
        channels_read(reads or TRAINABLE),
        options,
        render,
    )
    print(f"{folder}: {rendered} clips rendered")


def train(
    names: Denoisers = (),
    data: DataOfBudget = None,
    runs: Runs = Path("runs"),
    budget: Budget = "quick",
    seed: int = 0,
    precision: Literal["float32", "bfloat16"] | None = None,
    micro_batch: Annotated[int | None, arg(metavar="N")] = None,
    from_: Annotated[str | None, arg(name="from", metavar="weights|FILE")] = None,
    specialise: Annotated[bool, FlagCreatePairsOff] = False,
) -> None:
    """Train wskp6, in other budgets than quick rae and ntd-mean too, or the networks named; or go on with that.

    On several GPUs or machines: `torchrun --nproc-per-node N -m onespp train ...`. A batch is shared by all processes,
    so the steps stay the same.

    Args:
        precision: by default the fastest on this machine.
        micro_batch: sequences or crops of a batch in memory together, to train in less: their gradients accumulate.
        from_: weights of the same network to begin with, "weights" for the shipped ones, to fit them to the scenes of
            this data set; what comes out takes another --runs.
        specialise: leave out of the network's inputs what does not vary in this data set, such as a white albedo.
    """
    from train.loop import train_network
    from train.recipes import trained_by_default
    from train.registry import start_file, task_for

    folder = data_folder(data, budget)
    for name in names or trained_by_default(budget):
        start = start_file(name, from_)
        train_network(task_for(name, folder, runs, budget, seed, precision, micro_batch, start, specialise))


def evaluate(
    names: Denoisers = (),
    data: Annotated[tuple[Path, ...], arg(metavar="DIR...", help="data sets; by default data/BUDGET")] = (),
    runs: Runs = Path("runs"),
    budget: Budget = "quick",
    processes: Annotated[int, arg(metavar="N", help="at most so many clips side by side")] = os.cpu_count() or 1,
    device: Device = "cpu",
) -> None:
    """Judge all denoisers that can run, or those named, on the test clips: table, pictures, results.json.

    Networks have the weights that are shipped (`onespp weights`), and beside them, as NETWORK@BUDGET, those trained in
    this budget; or else those alone. What has been judged before, of the same clips, weights and code, is kept.
    """
    from eval.harness import evaluate as evaluate_on

    evaluate_on(data or [data_folder(None, budget)], runs, budget, names, processes, device)


def report(
    runs: Runs = Path("runs"),
    megabytes: Annotated[float, arg(help="of pictures; where not all frames fit, every n-th is shown")] = 24,
) -> None:
    """Make one page of all results, RUNS/report/index.html, which needs no network; and an animation of each clip."""
    from eval.report.page import report as make_report

    page, *animations = make_report(runs, megabytes)
    for path in animations:
        print(path)
    print(f"open {page} in a browser")


def info(data: Path = Path("data/quick"), plot: Annotated[Path | None, arg(metavar="PNG")] = None) -> None:
    """Print what is in a data set: clips, how hard they are, channels, sizes, noise floors, times.

    Args:
        data: the data set.
        plot: draw a histogram of how hard the clips are as well.
    """
    from datasets.info import summarise

    print(summarise(data, plot))


def verify(data: Path = Path("data/quick")) -> None:
    """Check every file of a data set against its checksum and shape, and name what is damaged.

    Args:
        data: the data set.
    """
    from datasets.verify import find_problems

    problems = find_problems(data)
    for problem in problems:
        print(problem)
    if problems:
        raise BadInput(f"{data}: {len(problems)} problems; delete the clips named above and rerun `onespp dataset`")
    print(f"{data}: everything is as it was written")


def exr(
    source: Annotated[Path, Positional, arg(metavar="CLIP|DATA", help="the folder of a clip; for oidn of a data set")],
    out: Annotated[Path, Positional, arg(metavar="OUT", help="the folder to write")],
    layout: Literal["frames", "oidn"] = "frames",
) -> None:
    """Write OpenEXR files: a multi-layer file a frame of a clip, or a data set for OIDN's training; or go on with that.

    Args:
        layout: "frames" takes a clip, such as data/quick/test/cornell_box/000; "oidn" takes a data set, whose splits
            become OUT/train, OUT/valid and OUT/test for the preprocess.py of Intel Open Image Denoise.
    """
    from datasets.exr import export_clip
    from datasets.oidn_layout import export_dataset

    if layout == "oidn":
        print(f"{out}: {export_dataset(source, out)} noisy images with their references")
    else:
        print(f"{out}: {export_clip(source, out)} files")


def show(
    clip: ClipFolder,
    names: Denoisers = (),
    out: Annotated[Path, arg(metavar="DIR")] = Path("runs/show"),
    runs: Runs = Path("runs"),
    budget: Budget = "quick",
) -> None:
    """Draw a clip as all denoisers that can run show it, or those named.

    A contact sheet with errors, difference maps, and what each denoiser carries from frame to frame.
    """
    from eval.figures.show import show as draw

    for path in draw(clip, out, runs, budget, names):
        print(path)


def figure_triptych(
    scene: Annotated[str, Positional, arg(metavar="SCENE", help="a built-in one")] = "room-2014",
    denoiser: Annotated[str, arg(metavar="NAME")] = "one",
    out: Png = Path("runs/triptych.png"),
    runs: Runs = Path("runs"),
    frame: Annotated[int, arg(metavar="N", help="of the flight, which history leads to")] = 12,
    spp: Annotated[int, arg(metavar="N", help="samples a pixel of the reference")] = 512,
) -> None:
    """Draw a frame of 1280 x 720 in three strips: one sample a pixel, denoised, and the reference. Minutes."""
    from eval.studies.triptych import triptych

    out.parent.mkdir(parents=True, exist_ok=True)
    triptych(out, scene, denoiser, runs, frame, spp)
    print(out)


def export(
    name: Annotated[str, Positional, arg(metavar="DENOISER", help="wskp3 or wskp6; trained here: wskp6@BUDGET")],
    to: Literal["onnx", "pt2"] = "onnx",
    out: Annotated[Path | None, arg(metavar="DIR", help="by default RUNS/export/DENOISER-TO")] = None,
    runs: Runs = Path("runs"),
    weights: Annotated[Path | None, arg(metavar="FILE", help="by default those shipped")] = None,
    precision: Annotated[Literal["float32", "float16"], arg(help="of the network")] = "float32",
    warp: Annotated[
        Literal["inside", "outside"], arg(help="whether the file moves its history along with the surfaces itself")
    ] = "inside",
) -> None:
    """Write a trained denoiser as one file for engines, with a manifest, golden frames and a page on how to call it."""
    from eval.export import export as write

    print(write(name, to, runs, weights, precision, warp, out))


def bench_export(
    name: Annotated[str, Positional, arg(metavar="DENOISER", help="wskp3 or wskp6")] = "wskp6",
    runs: Runs = Path("runs"),
    size: Size = "1280x720",
    threads: Annotated[int | None, arg(metavar="N", help="by default all of PyTorch's")] = None,
) -> None:
    """An exported denoiser under onnxruntime, next to ours."""
    from eval.bench.export import bench_export as bench

    print(bench(runs, name, size, threads))


def bench_denoisers(
    names: Denoisers = (),
    runs: Runs = Path("runs"),
    size: Sizes = ("1280x720",),
    threads: Annotated[tuple[int, ...], arg(metavar="N...", help="by default 1, and all of PyTorch's")] = (),
) -> None:
    """Milliseconds and memory of a frame, next to OIDN, of all denoisers or those named."""
    from eval.bench.denoisers import bench_denoisers as bench

    print(bench(runs, names, size, threads))


def bench_rendering(names: Scenes = (), runs: Runs = Path("runs")) -> None:
    """Samples a second and seconds to a noise floor of 40 dB, next to stock Mitsuba, of eight scenes or those named."""
    from eval.bench.rendering import bench_rendering as bench

    print(bench(runs, names))


def bench_light(names: Denoisers = (), runs: Runs = Path("runs"), budget: Budget = "quick") -> None:
    """How soon a change of light shows: quality frame by frame after a lamp is switched or moved, next to still light.

    Renders four clips of the Cornell box, a minute or a few; table, plot, results.json.
    """
    from eval.studies.light import bench_light as bench

    print(bench(runs, names, budget))


def bench_error(names: Denoisers = (), runs: Runs = Path("runs")) -> None:
    """Whether the error that halves of the samples tell is the true one, and whether more are asked for than needed.

    Renders four clips, ten minutes or so, and filters them at 4 to 128 samples a pixel; table, plots, results.json.
    """
    from eval.studies.error import bench_error as bench

    print(bench(runs, names))


def bench_training(
    names: Denoisers = (), data: DataOfBudget = None, runs: Runs = Path("runs"), budget: Budget = "quick"
) -> None:
    """Milliseconds of a training step and where they go, of rae, wskp6 and ntd or the networks named."""
    from eval.bench.training import bench_training as bench

    print(bench(data_folder(data, budget), runs, budget, names))


def stress(
    names: Denoisers = (),
    runs: Runs = Path("runs"),
    budget: Budget = "quick",
    long: Annotated[bool, FlagCreatePairsOff, arg(help="play sequences of 10 000 frames as well (minutes)")] = False,
    precision: Annotated[Literal["float32", "bfloat16", "float16"], arg(help="of networks, in all cases")] = "float32",
) -> None:
    """Put all denoisers that can run, or those named, to the extremes: tables, results.json, a picture.

    Networks have their shipped weights, or else those trained in this budget, or else fresh ones. Exits with 1 if a
    requirement is broken.
    """
    from eval.stress.run import stress as put_to_the_extremes

    if not put_to_the_extremes(runs, names, budget, long, precision):
        sys.exit(1)


def trade(
    names: Denoisers = (),
    data: DataOfBudget = None,
    runs: Runs = Path("runs"),
    budget: Budget = "quick",
    size: Annotated[str, arg(metavar="WxH", help="of the images that were timed")] = "1280x720",
    threads: Annotated[int | None, arg(metavar="N", help="that were timed; by default the most")] = None,
    spp: Annotated[tuple[int, ...], arg(metavar="N...", help="samples a pixel to feed, rising")] = SAMPLES,
) -> None:
    """Weigh quality against milliseconds: denoisers, precisions, sizes of networks, samples a pixel.

    Judges all denoisers that can run, or those named, on the test clips: tables, plots, RUNS/report/trade.json. Times
    are those that `onespp bench denoisers` has measured.
    """
    from eval.tradeoff.run import trade as weigh

    print(weigh(data_folder(data, budget), runs, budget, names, size, threads, spp))


Patterns = tuple[str, ...]  # such as 'frames/*.exr', or files


def denoise(
    frames: Annotated[
        Patterns, Positional, arg(metavar="PATTERN...", help="files with the colour, often with all layers")
    ] = (),
    denoiser: Annotated[str, arg(metavar="DENOISER", help="of networks trained here NETWORK@BUDGET")] = "one",
    out: Annotated[Path, arg(metavar="DIR", help="where denoised frames go, under their own names")] = Path("denoised"),
    weights: Annotated[Path | None, arg(metavar="FILE", aliases=["-w"], help="by default those shipped")] = None,
    runs: Runs = Path("runs"),
    hdr: Annotated[Patterns, arg(metavar="PATTERN...", help="the same as the colour's files")] = (),
    half: Annotated[Patterns, arg(metavar="PATTERN...", help="the frames by as many other samples, for NAME+js")] = (),
    alb: Annotated[Patterns, arg(metavar="PATTERN...", help="albedo in files of its own")] = (),
    nrm: Annotated[Patterns, arg(metavar="PATTERN...", help="normals in files of their own")] = (),
    mv: Annotated[Patterns, arg(metavar="PATTERN...", help="motion vectors in files of their own")] = (),
    depth: Annotated[Patterns, arg(metavar="PATTERN...", help="depth in files of its own")] = (),
    layers: Annotated[tuple[str, ...], arg(metavar="QUANTITY=LAYER...")] = (),
    motion: Annotated[str | None, arg(metavar="PAIR,SIGNx,SIGNy,UNIT")] = None,
    ref: Annotated[Patterns, arg(metavar="PATTERN...", aliases=["-r"], help="references to measure against")] = (),
    frame_range: Annotated[
        str | None, arg(name="frames", metavar="A-B", help="the numbers of those to denoise")
    ] = None,
    reset_at: Annotated[tuple[int, ...], arg(metavar="N...", help="frames after a cut: no history leads there")] = (),
    quality: Annotated[Literal["high", "balanced", "fast"] | None, arg(aliases=["-q"], help="OIDN's")] = None,
    stored_as: Annotated[Literal["half", "float"] | None, arg(name="as", help="by default as they were")] = None,
    png: Annotated[bool, FlagCreatePairsOff, arg(help="write a preview beside each frame")] = False,
    spp: Annotated[float, arg(metavar="N", help="samples a pixel of the frames, of each --half")] = 1.0,
    error: Annotated[bool, FlagCreatePairsOff] = False,
    until: Annotated[float | None, arg(metavar="E")] = None,
    threads: Annotated[int | None, arg(metavar="N", help="by default all of PyTorch's")] = None,
) -> None:
    """Denoise a sequence of OpenEXR files from any renderer, or go on with it.

    Layers are found by the names in use; what motion vectors mean is found out. All of it is printed at the start.

    Args:
        layers: say yourself what is where, such as albedo=MyAOV.albedo or motion=Vec.X,Vec.Y.
        motion: say yourself what motion vectors mean, such as XY,+x,-y,pixels, in the words that are printed.
        error: add the layer `error` to each frame: how far pixels are from the truth, by NAME+js and halves, which take
            three passes instead of one.
        until: tell which frames have a relative error of at most E, such as 0.02, and how many samples the others take.
    """
    from denoise.run import Job
    from denoise.run import denoise as denoise_sequence
    from eval.bench.sizes import threads_or_all
    from eval.selection import weights_of
    from models.registry import parse_name
    from timing import thread_count

    colour = (*frames, *hdr)
    if not colour:
        raise BadInput("name the frames to denoise, such as 'frames/*.exr'")
    weights = weights or weights_of(parse_name(denoiser), runs)
    passes = {"colour": colour, "half": half, "albedo": alb, "normal": nrm, "motion": mv, "depth": depth}
    patterns = {name: each for name, each in passes.items() if each}
    selection = (layers, motion, ref, frame_range, reset_at)
    with thread_count(threads_or_all(threads)):
        denoise_sequence(Job(patterns, denoiser, out, weights, *selection, quality, stored_as, png, spp, error, until))


def weights(
    name: Annotated[str | None, Positional, arg(metavar="NETWORK", help="whose card to show")] = None,
    card: Annotated[Path | None, arg(metavar="RUNS")] = None,
) -> None:
    """List the networks whose trained weights are shipped, which is all that they need; or show the card of one.

    Args:
        card: write the facts of its card anew, or of all cards: those of its weights, and what `onespp eval` has left
            in RUNS.
    """
    from eval.shipped import card_file, measure_card, table
    from models.shipped_weights import shipped_names

    if card:
        for each in [name] if name else shipped_names():
            print(measure_card(each, card))
    else:
        print(card_file(name).read_text().strip() if name else table())


Command = Callable[..., None]
Commands = dict[str, "Command | Commands"]

GROUPS: dict[str, Commands] = {
    "A first day": {
        "preview": preview,
        "dataset": dataset,
        "train": train,
        "eval": evaluate,
        "report": report,
    },
    "Data sets": {
        "info": info,
        "verify": verify,
        "exr": exr,
    },
    "Your own frames": {
        "denoise": denoise,
        "weights": weights,
    },
    "A closer look": {
        "show": show,
        "figure": {
            "triptych": figure_triptych,
        },
    },
    "Elsewhere": {
        "export": export,
    },
    "What it costs, what it stands": {
        "bench": {
            "denoisers": bench_denoisers,
            "export": bench_export,
            "rendering": bench_rendering,
            "light": bench_light,
            "error": bench_error,
            "training": bench_training,
        },
        "trade": trade,
        "stress": stress,
    },
}
TITLE = "onespp: from a 3-D scene to a real-time Monte Carlo denoiser you can trust."
MARGIN = 14  # characters left of the summaries
SUMMARIES = {
    "figure": "Draw a figure of the papers or of the docs: variance, unbiased, triptych.",
    "bench": "Measure this machine: denoisers, scaling, fusion, export, rendering, light, error, loading, training.",
}


def main(arguments: list[str] | None = None) -> None:
    """Run one command. Exits with 2 and one line on what the user can fix, 130 when interrupted."""
    words = sys.argv[1:] if arguments is None else arguments
    keep_freed_memory()
    try:
        run(words)
    except BadInput as error:
        sys.exit(complain(str(error)))
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        remedy = "make room" if full else "mend that or choose another folder"
        sys.exit(complain(f"{where}{error.strerror or error}; {remedy} and run it again"))
    except KeyboardInterrupt:
        print("\ninterrupted; run the same command again to go on", file=sys.stderr)
        sys.exit(130)


def run(words: list[str]) -> None:
    """Find the command that `words` begin with, and call it with the rest. Prints an overview where it is asked for."""
    path = "onespp"
    groups = GROUPS
    while True:
        commands = {name: command for group in groups.values() for name, command in group.items()}
        if not words or words[0] in ("-h", "--help"):
            print("\n".join(overview(path, groups)))
            return
        name, *words = words
        if name not in commands:
            raise BadInput(f"unknown command '{path} {name}'; the commands are {', '.join(commands)}")
        path = f"{path} {name}"
        command = commands[name]
        if not isinstance(command, dict):
            tyro.cli(command, prog=path, args=words)
            return
        groups = {SUMMARIES[name]: command}


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


def complain(message: str) -> int:
    """Print what the user can fix. Returns the exit code."""
    print(f"onespp: {message}", file=sys.stderr)
    return 2
