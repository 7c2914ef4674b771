"""The command line: one subcommand a step, each thin."""

import errno
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import tyro

from errors import BadInput

Data = Annotated[Path | None, tyro.conf.arg(metavar="DIR", help="the data set's folder; by default data/PROFILE")]
Runs = Annotated[Path, tyro.conf.arg(metavar="DIR", help="where trainings and results are kept")]
Profile = Annotated[
    str,
    tyro.conf.arg(
        metavar="NAME", help="how much of everything: tiny (seconds), quick (minutes), release (days), or its sketch"
    ),
]
Precision = Annotated[
    Literal["32-true", "bf16-mixed"] | None, tyro.conf.arg(help="of training; by default the fastest on this machine")
]
Names = Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="DENOISER...")]
PartArgument = Annotated[
    str | None,
    tyro.conf.arg(metavar="K/N", help="render only the K-th of N disjoint shares, to spread the work over machines"),
]
Reads = Annotated[
    tuple[str, ...],
    tyro.conf.arg(metavar="DENOISER...", help="render for training only what these denoisers read, or else all known"),
]
RayArgument = Annotated[
    bool,
    tyro.conf.FlagCreatePairsOff,
    tyro.conf.arg(
        help="render on the Ray cluster of RAY_ADDRESS, or else on all cores of this machine; every machine must reach "
        "the data set's folder under the same path"
    ),
]
Halton = Annotated[
    bool,
    tyro.conf.FlagCreatePairsOff,
    tyro.conf.arg(help="draw noisy frames from a cycle of 16 Halton points with a shift of each pixel (SVGF, RAE)"),
]
Regularise = Annotated[
    bool,
    tyro.conf.FlagCreatePairsOff,
    tyro.conf.arg(help="blur glossy materials after the first bounce (RAE): fewer fireflies, softer caustics"),
]
Folder = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
Scenes = Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="SCENE...")]


def data_folder(data: Path | None, profile: str) -> Path:
    return Path("data") / profile if data is None else data


def dataset(
    data: Data = None,
    profile: Profile = "quick",
    seed: int = 0,
    reads: Reads = (),
    part: PartArgument = None,
    ray: RayArgument = False,
    halton: Halton = False,
    regularise: Regularise = False,
) -> None:
    """Render the clips of a profile that are not there yet."""
    from datasets.generate import Part, generate, render_here
    from models.registry import channels_read
    from render.clip import Options

    if ray:
        from datasets.cluster import render_on_cluster
    folder = data_folder(data, profile)
    share = Part.parse(part) if part else None
    channels = channels_read(reads)
    options = Options(halton, regularise)
    render = render_on_cluster if ray else render_here
    rendered = generate(folder, profile, seed, share, channels, options, render)
    print(f"{folder}: {rendered} clips rendered")


def verify(folder: Folder) -> None:
    """Check every file of a data set against its checksum and shape; names what is damaged."""
    from datasets.inspect import verify as find_problems

    problems = find_problems(folder)
    for problem in problems:
        print(problem)
    if problems:
        raise BadInput(f"{folder}: {len(problems)} problems; delete the clips named above and rerun `onespp dataset`")
    print(f"{folder}: everything is as it was written")


def info(folder: Folder, plot: Path | None = None) -> None:
    """Print what is in a data set: clips, how hard they are, channels, sizes and what is saved, noise floors, times.

    Args:
        plot: write a histogram of how hard the clips are to this PNG as well.
    """
    from datasets.inspect import info as describe

    print(describe(folder, plot))


def train(
    names: Names = (),
    data: Data = None,
    runs: Runs = Path("runs"),
    profile: Profile = "quick",
    seed: int = 0,
    precision: Precision = None,
    at_once: int | None = None,
) -> None:
    """Train denoisers (rae, wskp6 and ntd, unless some are named), or go on where a training was interrupted.

    On several GPUs or machines: `torchrun --nproc-per-node N -m onespp train ...`. A batch is shared by all processes,
    so the steps stay the same.

    Args:
        at_once: sequences or crops of a batch in memory together, to train in less: their gradients accumulate.
    """
    from train.loop import task_for, train_network
    from train.recipes import DEFAULT

    for name in names or DEFAULT:
        train_network(task_for(name, data_folder(data, profile), runs, profile, seed, precision, at_once))


def evaluate(
    names: Names = (),
    data: Data = None,
    runs: Runs = Path("runs"),
    profile: Profile = "quick",
    processes: int = os.cpu_count() or 1,
) -> None:
    """Judge denoisers (all that can run, unless some are named) on the test clips: table, pictures, results.json.

    What has been judged before, of the same clips, weights and code, is kept.

    Args:
        processes: at most so many clips side by side; by default one on each processor.
    """
    from eval.harness import evaluate as run

    run(data_folder(data, profile), runs, profile, names, processes)


def preview(names: Scenes = (), out: Path = Path("runs/preview.png"), seed: int = 0, spp: int = 64) -> None:
    """Draw a contact sheet of scenes (16 rooms, unless some are named): the middle frame of each, its own exposure."""
    from eval.figures.contact_sheet import contact_sheet

    out.parent.mkdir(parents=True, exist_ok=True)
    contact_sheet(out, names or [f"room-{number}" for number in range(16)], seed, spp=spp)
    print(out)


def show(
    clip: Folder,
    names: Names = (),
    out: Path = Path("runs/show"),
    runs: Runs = Path("runs"),
    profile: Profile = "quick",
) -> None:
    """Draw a clip's folder as denoisers (all that can run, unless some are named) show it: PNGs into --out.

    A contact sheet with errors, difference maps, and what each denoiser carries from frame to frame.
    """
    from eval.figures.show import show as draw

    for path in draw(clip, out, runs, profile, names):
        print(path)


def figure(
    what: Annotated[Literal["variance", "unbiased"], tyro.conf.Positional],
    out: Annotated[Path, tyro.conf.arg(metavar="PNG")],
) -> None:
    """Draw a figure of the papers or of the docs.

    variance: SVGF's estimate of variance, spatial and temporal, on noise that grows from left to right (Fig. 9).
    unbiased: an image's plain and unbiased MSE against references of 16 to 1024 spp, and how true noise floors are.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    if what == "variance":
        from eval.figures.variance import variance_figure as draw
    else:
        from eval.figures.unbiased import unbiased_figure as draw
    draw(out)
    print(out)


def bench(
    what: Annotated[
        Literal["denoisers", "scaling", "fusion", "loading", "rendering", "training"], tyro.conf.Positional
    ],
    names: Names = (),
    data: Data = None,
    runs: Runs = Path("runs"),
    profile: Profile = "quick",
    size: Annotated[tuple[str, ...], tyro.conf.arg(metavar="WxH...")] = (),
    threads: Annotated[tuple[int, ...], tyro.conf.arg(metavar="N...")] = (),
) -> None:
    """Measure this machine.

    denoisers: milliseconds and memory a frame, next to OIDN, of all denoisers unless some are named.
    scaling: milliseconds against pixels, of all denoisers unless some are named; a plot.
    fusion: weight-shared kernel fusion, next to the straightforward way.
    loading: how fast training sequences come from disk, next to how fast they are trained on, and in how much memory.
    rendering: samples a second and seconds to a noise floor of 40 dB, next to Mitsuba's stock integrator and sampler.
    training: milliseconds a step of rae, wskp6 and ntd, unless some are named, and where they go.

    Args:
        size: of images, by default 1280x720 (several for denoisers), and 320x180 to 1920x1080 for scaling.
        threads: for denoisers (several; by default 1 and all that PyTorch takes), scaling and fusion (by default all).
    """
    usual = ("1280x720",)
    if what == "denoisers":
        from eval.bench.denoisers import bench_denoisers

        print(bench_denoisers(runs, names, size or usual, threads))
    elif what == "scaling":
        from eval.bench.scaling import bench_scaling

        print(bench_scaling(runs, names, size, threads))
    elif what == "fusion":
        from eval.bench.fusion import bench_fusion

        print(bench_fusion(runs, (size or usual)[0], max(threads, default=None)))
    elif what == "rendering":
        from eval.bench.rendering import bench_rendering

        print(bench_rendering(runs))
    elif what == "training":
        from eval.bench.training import bench_training

        print(bench_training(data_folder(data, profile), runs, profile, names))
    else:
        from eval.bench.loading import bench_loading

        print(bench_loading(data_folder(data, profile), runs, profile))


def stress(
    names: Names = (),
    runs: Runs = Path("runs"),
    profile: Profile = "quick",
    long: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False,
    precision: Annotated[
        Literal["float32", "bfloat16", "float16"], tyro.conf.arg(help="of networks; at all extremes")
    ] = "float32",
) -> None:
    """Put denoisers (all that can run, unless some are named) to the extremes: tables, results.json, a picture.

    Networks have the weights trained in this profile, or else fresh ones. Exits with 1 if a requirement is broken.

    Args:
        long: play sequences of 10 000 frames as well (minutes).
    """
    from eval.stress.run import stress as run

    if not run(runs, names, profile, long, precision):
        sys.exit(1)


def ablate(
    what: Annotated[Literal["rae-inputs", "rae-loss", "wskp-windows", "wskp-repvgg", "ntd"], tyro.conf.Positional],
    data: Data = None,
    runs: Runs = Path("runs"),
    profile: Profile = "quick",
    seeds: int = 1,
) -> None:
    """Repeat an ablation of the papers, or go on with it: table beside the paper's findings, plot, results.json.

    rae-inputs: what RAE gains by demodulation, normals, depth and roughness (Fig. 3).
    rae-loss: what the gradient and temporal terms of its loss add to the spatial one (§4.4).
    wskp-windows: windows of 3 to 13 pixels alone and together (WSKP, Fig. 9 and 10).
    wskp-repvgg: wskp6 and kp with and without RepVGG blocks (WSKP, Table 5).
    ntd: ntd-a, ntd-b and ntd where meshes move (NTD §6.3).

    Args:
        seeds: trainings of each network, whose mean and spread are shown.
    """
    from eval.ablation.run import ablate as run

    print(run(what, data_folder(data, profile), runs, profile, seeds))


def trade(
    names: Names = (),
    data: Data = None,
    runs: Runs = Path("runs"),
    profile: Profile = "quick",
    size: Annotated[str, tyro.conf.arg(metavar="WxH")] = "1280x720",
    threads: int | None = None,
    spp: Annotated[tuple[int, ...], tyro.conf.arg(metavar="N...")] = (1, 2, 4, 8, 16, 32, 64, 128, 256),
) -> None:
    """Weigh quality against milliseconds: denoisers, precisions, sizes of networks, samples a pixel; tables and plots.

    Judges denoisers (all that can run, unless some are named) on the test clips, for RUNS/report/trade.json and the
    report. Times are those that `onespp bench denoisers` has measured.

    Args:
        size: of images, for the times.
        threads: for the times; by default the most that the bench has measured.
        spp: samples a pixel to feed, rising.
    """
    from eval.tradeoff.run import trade as run

    print(run(data_folder(data, profile), runs, profile, names, size, threads, spp))


def papers(runs: Runs = Path("runs"), profile: Profile = "quick") -> None:
    """Print what the papers measured on their scenes beside what was measured here, and which orders hold here too."""
    from eval.papers.compare import against_papers

    print(against_papers(runs, profile))


def report(
    runs: Runs = Path("runs"),
    megabytes: Annotated[float, tyro.conf.arg(help="of pictures; where not all frames fit, every n-th is shown")] = 24,
) -> None:
    """Make one page of all results, RUNS/report/index.html, which needs no network; and an animated picture a clip."""
    from eval.report.page import report as make

    for path in make(runs, megabytes):
        print(path)


def exr(clip: Folder, out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]) -> None:
    """Write one multi-layer OpenEXR file a frame of a clip's folder (such as data/quick/test/cornell_box/000)."""
    from datasets.exr import export_clip

    print(f"{out}: {export_clip(clip, out)} files")


COMMANDS: dict[str, Callable[..., None]] = {
    **{"preview": preview, "dataset": dataset, "verify": verify, "info": info, "train": train, "eval": evaluate},
    **{"show": show, "figure": figure, "exr": exr, "bench": bench, "stress": stress, "ablate": ablate},
    **{"trade": trade, "papers": papers, "report": report},
}


def main(arguments: list[str] | None = None) -> None:
    """Run one subcommand. Exits with 2 and one line on what the user can fix, 130 when interrupted."""
    try:
        tyro.extras.subcommand_cli_from_dict(COMMANDS, prog="onespp", args=arguments, description=__doc__)
    except BadInput as error:
        sys.exit(_complain(str(error)))
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        remedy = "make room" if full else "mend that or choose another folder"
        sys.exit(_complain(f"{where}{error.strerror or error}; {remedy} and run it again"))
    except KeyboardInterrupt:
        print("\ninterrupted; run the same command again to go on", file=sys.stderr)
        sys.exit(130)


def _complain(message: str) -> int:
    print(f"onespp: {message}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    main()
