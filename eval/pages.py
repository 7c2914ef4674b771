"""Tables and numbers of the documentation, generated from the measurements in docs/measured.

The text of a page between `<!-- measured: NAME ARGUMENT... -->` and `<!-- end -->` is that of GENERATORS[NAME].
`python -m eval.pages RUNS` extracts the measurements that commands left in RUNS and rewrites the pages; without RUNS it
only rewrites the pages.
"""

import json
import math
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

from tabulate import tabulate

from errors import BadInput
from eval.metrics import METRICS, Values, mean_floor, means
from eval.results import FLOOR, NOISE_FLOOR, ClipResults, Result, of_one_spp, read_results
from eval.tables import AGES, PRINTED, ClipScores, TableRow, clip_rows, mean_rows, source_of_denoiser, value_cell
from eval.tradeoff.trades import Trade, psnr_front
from files import read_json, write_file, write_json
from provenance import ROOT, device_in_words

MEASURED = ROOT / "docs" / "measured"
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
FURTHER_PAGES = (ROOT / "runtime" / "README.md", ROOT / "models" / "shipped" / "one.md")
MARKED = re.compile(r"<!--\s*measured:\s+(.+?)\s*-->.*?<!--\s*end\s*-->", re.DOTALL)  # lines may be broken anywhere
GLASS_FRAME = 4  # the frame from which on clips of glass are compared: history has grown
STEADY_FRAME = 15  # that of the benchmark: history no longer grows
SHOWN_METRICS = ("ssim", "flip", "temporal_error", "psnr")


# --- Extracts ---------------------------------------------------------------------------------------------------------


def rounded(content: Any) -> Any:
    """JSON content with numbers of nine digits: no second rounding changes what is printed."""
    return json.loads(json.dumps(content), parse_float=lambda text: float(f"{float(text):.9g}"))


def extract_eval(runs: Path) -> dict[str, Any]:
    """Clips with the metrics of all denoisers."""
    content, clips = read_results(runs)
    clips = of_one_spp(clips)
    rows = [
        {
            **{"scene": clip.scene, "clip": clip.clip, "signal": clip.signal, "floors": kept(clip.reference.metrics)},
            "results": {result.denoiser: kept(result.metrics) for result in clip.results},
        }
        for clip in clips
    ]
    facts = {key: content[key] for key in ("device", "versions", "dataset")}
    return facts | {"clips": rows}


def kept(values: Values) -> Values:
    return {metric: values.get(metric) for metric in PRINTED}


def extract_keys(file: str, *keys: str) -> Callable[[Path], dict[str, Any]]:
    """Some of the content of a JSON file."""
    return lambda runs: {key: value for key, value in read_json(runs / file, keys).items() if key in keys}


def extract_trade(runs: Path) -> dict[str, Any]:
    """Denoisers by samples per pixel, with the metrics that are printed."""
    content = extract_keys("report/trade.json", "device", "size", "threads", "clips", "samples")(runs)
    rows = [row | {name: kept(row[name]) for name in ("metrics", "floors")} for row in content["samples"]]
    return content | {"samples": rows}


def extract_stress(runs: Path) -> dict[str, Any]:
    """The worst of all cases for each denoiser, and the requirements that it breaks."""
    content = read_json(runs / "stress" / "results.json")
    rows: dict[str, dict[str, Any]] = {}
    for row in content["rows"]:
        worst = rows.setdefault(row["denoiser"], {"cases": 0, "violation": 0.0, "nonfinite": 0, "broken": []})
        worst["cases"] += 1
        worst["violation"] = max(worst["violation"], row["violation"])
        worst["nonfinite"] += row["nonfinite"]
        worst["broken"] += [f"{name} in {row['extreme']}" for name in row["broken"]]
    return {"device": content["device"], "rows": rows}


def steady_clips(runs: Path, first: int) -> list[dict[str, Any]]:
    """Metrics of all denoisers in total light, and their noise floors, from frame `first` of each clip of 1 spp on."""
    rows = []
    for clip in of_one_spp([clip for clip in read_results(runs)[1] if clip.signal == "total"]):
        values = {result.denoiser: kept(means(result.frames[first:])) for result in clip.results}
        values[NOISE_FLOOR] = kept(mean_floor(clip.reference.frames[first:]))
        rows.append({"scene": clip.scene, "clip": clip.clip, "results": values})
    return rows


def extract_glass(runs: Path) -> dict[str, Any]:
    """Results on the profile `glass`, with what glass shows as guides and with first hits."""
    content, _ = read_results(runs / "glass")
    folders = {"what it shows": runs / "glass", "first hits": runs / "glass" / "first-hits"}
    return {
        "device": content["device"],
        "clips": {guides: steady_clips(path, GLASS_FRAME) for guides, path in folders.items()},
    }


def extract_benchmark(runs: Path) -> dict[str, Any]:
    """Results of RUNS/benchmark* by folder: by the age of the history, by scene once it is steady, and of rendering."""
    files = sorted(runs.glob("benchmark*/benchmark.json"))
    if not files:
        raise BadInput(f"no {runs / 'benchmark' / 'benchmark.json'}")
    folders = {}
    devices: dict[str, None] = {}  # in order
    for file in files:
        content = read_json(file, ("device", "by_age", "rendered", "where"))
        clips = steady_clips(file.parent, STEADY_FRAME)
        kept_keys = {key: content[key] for key in ("rendered", "where")}
        folders[file.parent.name] = {"ages": content["by_age"]["psnr"], "clips": clips} | kept_keys
        devices[content["device"]] = None
    return {"device": " and ".join(devices), "folders": folders}


def extract_times(runs: Path) -> dict[str, Any]:
    """Seconds that the first `make` after set-up and `make test` took, which they leave in RUNS, on this machine."""
    files = {name: runs / f"{name}.seconds" for name in ("make", "test")}
    if missing := [str(file) for file in files.values() if not file.exists()]:
        raise BadInput(f"{' and '.join(missing)} missing")
    return {"device": device_in_words()} | {name: int(file.read_text()) for name, file in files.items()}


EXTRACTS: dict[str, tuple[str, Callable[[Path], dict[str, Any]]]] = {  # the command that measures, and the extract
    "eval": ("onespp eval", extract_eval),
    "bench": ("onespp bench denoisers", extract_keys("bench/results.json", "device", "threads", "rows")),
    "trade": ("onespp trade", extract_trade),
    "stress": ("onespp stress --long", extract_stress),
    "times": ("make", extract_times),
    "benchmark": ("onespp benchmark run --scenes DIR", extract_benchmark),
    "glass": ("onespp eval --data data/glass --runs RUNS/glass", extract_glass),
    "runtime": ("python -m runtime.measure", extract_keys("runtime/results.json", "device", "size", "rows")),
}


def collect(runs: Path) -> None:
    """Extract what RUNS holds of EXTRACTS into docs/measured; prints the files."""
    for name, (_, extract) in EXTRACTS.items():
        try:
            content = extract(runs)
        except BadInput as missing:
            print(f"{name}: not collected, {missing}")
            continue
        path = MEASURED / f"{name}.json"
        write_json(path, rounded(content))
        print(path)


# --- Tables and numbers -----------------------------------------------------------------------------------------------


def measured(name: str) -> dict[str, Any]:
    """An extract. Raises BadInput, naming the command that measures it, where there is none."""
    path = MEASURED / f"{name}.json"
    if not path.exists():
        raise BadInput(f"not measured: `{EXTRACTS[name][0]}`, then `python -m eval.pages RUNS`")
    return read_json(path)


def evaluated_clips(signal: str = "total") -> list[ClipResults]:
    """The clips of `onespp eval` with the denoisers that return a signal."""
    clips = []
    for row in measured("eval")["clips"]:
        if row["signal"] == signal:
            place = {"key": "", "signal": signal, "scene": row["scene"], "clip": row["clip"], "frames": []}
            results = [Result(denoiser=name, metrics=values, **place) for name, values in row["results"].items()]
            reference = Result(denoiser=NOISE_FLOOR, metrics=row["floors"], **place)
            clips.append(ClipResults(row["scene"], row["clip"], row["signal"], results, reference))
    return clips


def rows_of(clip: str, signal: str = "total") -> list[TableRow]:
    """The denoisers on a scene's clip, or the means over all clips for "mean"."""
    clips = evaluated_clips(signal)
    return mean_rows(clips) if clip == "mean" else next(clip_rows(each) for each in clips if each.scene == clip)


def table(lines: list[dict[str, Any]]) -> str:
    return f"\n{tabulate(lines, 'keys', 'github', disable_numparse=True)}\n"


def cell(row: TableRow) -> str:
    return row.denoiser if row.is_floor else f"`{row.denoiser}`"


def quality(metric: str, signal: str = "total") -> str:
    """A metric of all denoisers: its mean, and clip by clip."""
    columns = {"mean": "mean"} | {each.scene: each.scene for each in evaluated_clips(signal)}
    rows = {title: rows_of(clip, signal) for clip, title in columns.items()}
    lines = []
    for index, row in enumerate(rows["mean"]):
        values = {title: rows[title][index].text(metric) for title in columns}
        lines.append({"denoiser": cell(row), "made from": row.made_from} | values)
    return table(lines)


def timed_rows() -> list[dict[str, Any]]:
    """Rows of the bench with all threads, at the first of its sizes."""
    bench = measured("bench")
    first = bench["rows"][0]
    return [row for row in bench["rows"] if row["threads"] == bench["threads"] and row["height"] == first["height"]]


def times() -> str:
    """Milliseconds and memory of a frame, fastest first, with the signals that denoisers usually return."""
    usual = (row for row in timed_rows() if "(indirect)" not in row["denoiser"])
    rows = sorted(usual, key=lambda row: row["ms_median"])
    lines = [
        {
            "denoiser": f"`{row['denoiser']}`",
            "precision": row["dtype"],
            "ms": f"{row['ms_median']:.3g}",
            "peak MB": f"{row['peak_mb']:.0f}" if row["peak_mb"] is not None else "-",
        }
        for row in rows
    ]
    return table(lines)


def milliseconds(denoiser: str) -> str:
    """Of one frame by a denoiser, at the first size of the bench."""
    return f"{next(row['ms_median'] for row in timed_rows() if row['denoiser'] == denoiser):.0f}"


def metrics(*names: str) -> str:
    """The named metrics of the denoisers of `onespp trade` at 1 spp, where `+js` does nothing."""
    rows = [Trade(**row) for row in measured("trade")["samples"]]
    lines = [
        {"denoiser": f"`{row.denoiser}`", "made from": source_of_denoiser(row.denoiser)}
        | {METRICS[name].title: row.cell(name) for name in names}
        for row in rows
        if (row.signal, row.spp) == ("total", 1) and not row.denoiser.endswith("+js")
    ]
    return table(lines)


def samples() -> str:
    """PSNR of denoisers fed more samples a pixel."""
    lines: dict[str, dict[str, str]] = {}
    for row in (Trade(**row) for row in measured("trade")["samples"]):
        if row.signal == "total":
            facts = {"denoiser": f"`{row.denoiser}`", "made from": source_of_denoiser(row.denoiser)}
            lines.setdefault(row.denoiser, facts)[f"{row.spp} spp"] = row.cell("psnr")
    return table([*lines.values()])


def front() -> str:
    """Where milliseconds of rendering and filtering are best spent."""
    rows = [Trade(**row) for row in measured("trade")["samples"]]
    lines = [
        {
            "ms": f"{ms:.0f}",
            "spent on": f"`{row.denoiser}`, {row.spp} spp",
            "made from": source_of_denoiser(row.denoiser),
            "PSNR": row.cell("psnr"),
        }
        for ms, row in psnr_front(rows, "total")
    ]
    untimed = dict.fromkeys(f"`{row.denoiser}`" for row in rows if row.signal == "total" and row.ms is None)
    return table(lines) + (f"\nWithout a time: {', '.join(untimed)}.\n" if untimed else "")


def mean_row(clips: Sequence[dict[str, Any]], denoiser: str) -> TableRow:
    """Means of a denoiser, or of the noise floors, over clips of `steady_clips`."""
    scores = ClipScores([clip["results"][denoiser] for clip in clips], [clip["results"][NOISE_FLOOR] for clip in clips])
    return TableRow("mean", FLOOR if denoiser == NOISE_FLOOR else denoiser, "total", scores.means, scores.joint_floor)


def psnr_noise_off(clips: Iterable[dict[str, Any]], denoiser: str) -> float | None:
    """Mean PSNR of a denoiser over clips, in dB, of its squared error less that of the references' noise.

    None where a clip's error is within that noise.
    """
    pairs = [(clip["results"][denoiser]["psnr"], clip["results"][NOISE_FLOOR]["psnr"]) for clip in clips]
    own = [10 ** (-psnr / 10) - 10 ** (-floor / 10) for psnr, floor in pairs]
    return fmean(-10 * math.log10(error) for error in own) if min(own) > 0 else None


def noise_off(clips: Iterable[dict[str, Any]], denoiser: str) -> str:
    psnr = psnr_noise_off(clips, denoiser)
    return "" if psnr is None else f"{psnr:.2f}"


def glass() -> str:
    """PSNR of denoisers on scenes of glass, the mean of their clips, with either kind of guides; and temporal error."""
    lines: dict[str, dict[str, dict[str, str]]] = {}  # by denoiser and guides
    for guides, clips in measured("glass")["clips"].items():
        scenes = list(dict.fromkeys(clip["scene"].split("-")[1] for clip in clips))
        for denoiser in clips[0]["results"]:
            row = mean_row(clips, denoiser)
            line = {"denoiser": cell(row), "made from": row.made_from, "guides": "" if row.is_floor else guides}
            for scene in scenes:
                line[scene] = mean_row([clip for clip in clips if scene in clip["scene"]], denoiser).text("psnr")
            line |= {"mean": row.text("psnr"), "noise off": noise_off(clips, denoiser)}
            line |= {"temporal error": row.text("temporal_error")}
            lines.setdefault(denoiser, {})[line["guides"]] = line
    return table([line for alike in lines.values() for line in alike.values()])


def benchmark(folder: str) -> dict[str, Any]:
    """The results of `onespp benchmark run --runs RUNS/folder`. Raises BadInput where there are none."""
    folders = measured("benchmark")["folders"]
    if folder not in folders:
        raise BadInput(f"not measured: `onespp benchmark run --runs runs/{folder}`, then `python -m eval.pages runs`")
    return dict(folders[folder])


def ages(folder: str, *names: str) -> str:
    """PSNR of the benchmark's denoisers, or of the named ones, by the age of their history."""
    rows = benchmark(folder)["ages"]
    texts = {name: {age: value_cell("psnr", psnr) for age, psnr in rows[name].items()} for name in names or rows}
    return table(
        [{"denoiser": f"`{name}`", "made from": source_of_denoiser(name)} | row for name, row in texts.items()]
    )


def steady(folder: str, *names: str) -> str:
    """Means of the benchmark's clips with a steady history, and PSNR by scene; of the named denoisers, or of all.

    With the mean PSNR of our own rooms, those of RUNS/folder-own, where they were measured.
    """
    clips = benchmark(folder)["clips"]
    own_clips = measured("benchmark")["folders"].get(f"{folder}-own", {}).get("clips", [])
    lines = []
    for denoiser in (*names, NOISE_FLOOR) if names else clips[0]["results"]:
        row = mean_row(clips, denoiser)
        line = {"denoiser": cell(row), "made from": row.made_from}
        line |= {METRICS[metric].title: row.text(metric) for metric in SHOWN_METRICS}
        line |= {"noise off": noise_off(clips, denoiser)}
        line |= {clip["scene"]: mean_row([clip], denoiser).text("psnr") for clip in clips}
        if own_clips:
            own = [clip for clip in own_clips if denoiser in clip["results"]]
            line |= {f"{len(own_clips)} of ours": mean_row(own, denoiser).text("psnr") if own else ""}
        lines.append(line)
    return table(lines)


def lead(folder: str, denoiser: str, *peers: str) -> str:
    """How far a denoiser is ahead of peers in the benchmark's means; its temporal error beside theirs."""
    first_frame, *_ = AGES
    clips, by_age = benchmark(folder)["clips"], benchmark(folder)["ages"]
    without_noise = {name: psnr_noise_off(clips, name) for name in (denoiser, *peers)}

    def ahead_without_noise(peer: str) -> str:
        own, other = without_noise[denoiser], without_noise[peer]
        return "" if own is None or other is None else f"{own - other:+.2f} dB"

    def mean(metric: str, name: str) -> float:
        return fmean(clip["results"][name][metric] for clip in clips)

    def above_floor(name: str) -> float:
        return mean("temporal_error", name) - mean("temporal_error", NOISE_FLOOR)

    return table(
        [
            {
                f"`{denoiser}` beside": f"`{peer}`",
                first_frame: f"{by_age[denoiser][first_frame] - by_age[peer][first_frame]:+.2f} dB",
                "steady frames": f"{mean('psnr', denoiser) - mean('psnr', peer):+.2f} dB",
                "noise off": ahead_without_noise(peer),
                "SSIM": f"{mean('ssim', denoiser) - mean('ssim', peer):+.4f}",
                "temporal error above the floor": f"{100 * above_floor(denoiser) / above_floor(peer):.0f} %",
            }
            for peer in peers
        ]
    )


def where(folder: str, *questions: str) -> str:
    """Shares of the pixels and of the squared error of the benchmark's clips, by what `onespp eval --where` asks."""
    lines = []
    for scene, shares in benchmark(folder)["where"].items():
        for share, answers in shares.items():
            line = {"clip": scene, "share of": share if share == "pixels" else f"`{share}`"}
            for question in questions:
                every = dict.fromkeys(a for each in shares.values() for a in each.get(question, ()))
                own = answers.get(question, {})
                line |= {answer: f"{100 * own[answer]:.0f} %" if answer in own else "" for answer in every}
            lines.append(line)
    return table(lines)


def rendering(folder: str) -> str:
    """What the references of the benchmark's clips cost."""
    lines = [
        {
            "clip": row["scene"],
            "spp": str(row["reference_spp"]),
            "minutes": f"{row['seconds'] / 60:.1f}",
        }
        for row in benchmark(folder)["rendered"]
    ]
    return table(lines)


def stress() -> str:
    """The requirements of the stress bench that denoisers break."""
    rows = measured("stress")["rows"]
    lines = [
        {"denoiser": f"`{name}`", "broken": "; ".join(row["broken"])} for name, row in rows.items() if row["broken"]
    ]
    cases = sum(row["cases"] for row in rows.values())
    worst = max(row["violation"] for row in rows.values() if not row["broken"])
    text = f"{len(rows)} denoisers, {cases} cases; {len(lines) or 'none'} of them break a requirement."
    return f"{text} The others leave their range by at most {worst:.1g}.\n{table(lines) if lines else ''}"


def form_table(rows: list[dict[str, Any]]) -> str:
    """What each form of `one` takes, from rows of python -m runtime.measure."""
    lines = [
        {
            "form": row["form"],
            "MB to install": f"{row['megabytes']:.3g}",
            "s to build": "-" if row["build_seconds"] is None else f"{row['build_seconds']:.0f}",
            "ms": f"{row['ms']:.0f}",
            "times oidn": f"{row['ms'] / row['oidn_ms']:.2f}",
            "peak MB": "-" if row["peak_mb"] is None else f"{row['peak_mb']:.0f}",
        }
        for row in rows
    ]
    return table(lines)


def forms(name: str = "runtime") -> str:
    return form_table(measured(name)["rows"])


def device(name: str) -> str:
    """What a source was measured on."""
    return str(measured(name)["device"])


def size(name: str) -> str:
    """The size of the images that were timed for a source."""
    return str(measured(name)["size"]).replace("x", " × ")


def minutes(what: str) -> str:
    """How long a target of make took."""
    seconds = measured("times")[what]
    return f"{seconds // 60} min {seconds % 60} s"


GENERATORS: dict[str, Callable[..., str]] = {
    f.__name__: f
    for f in (
        *(quality, times, milliseconds, metrics, samples, front, glass, stress, device, size, minutes),
        *(ages, steady, lead, where, rendering, forms),
    )
}


# --- Pages ------------------------------------------------------------------------------------------------------------


def generate(match: re.Match[str]) -> str:
    """The text of a marked part."""
    name, *arguments = match[1].split()
    try:
        text = GENERATORS[name](*arguments)
    except BadInput as missing:
        text = f"({missing})"
    return f"<!-- measured: {' '.join(match[1].split())} -->{text}<!-- end -->"


def generated(page: str) -> str:
    """A page with all marked parts generated."""
    return MARKED.sub(generate, page)


def main(arguments: list[str]) -> None:
    for runs in arguments:
        collect(Path(runs))
    for page in (*PAGES, *FURTHER_PAGES):
        text = page.read_text()
        if (new := generated(text)) != text:
            write_file(page, new.encode())
            print(page)


if __name__ == "__main__":
    if any(argument.startswith("-") for argument in sys.argv[1:]):
        sys.exit(__doc__)
    main(sys.argv[1:])
