"""`onespp weights`: the networks whose weights are shipped, and a model card of each, generated from its files."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from tabulate import tabulate

from errors import BadInput
from eval.metrics import METRICS
from eval.results import RESULTS_FILE, ClipResults, of_one_spp, read_results, results_of
from eval.selection import baselines
from eval.tables import LEGEND, PRINTED, clip_rows, mean_rows
from files import read_json, write_file, write_json
from models.registry import require_shipped, shipped_names
from models.weights import read_metadata
from provenance import file_digest

WEIGHTS_LICENCE = "Apache-2.0"  # that of onespp
BEGIN = "<!-- facts: written by `onespp weights NETWORK --card RUNS` -->"
END = "<!-- end of facts -->"
LISTED_APART = ("budget", "seed", "data", "parameters", "step", "validation", "from")  # of the recipe, by cards

FACTS = Path(__file__).with_name("shipped_facts.md")  # with names in braces


def table() -> str:
    """All networks with shipped weights as a text table."""
    lines = []
    for name in shipped_names():
        path = require_shipped(name)
        recipe = read_metadata(path)["recipe"]
        line = {"network": name, "parameters": recipe["parameters"], "kB": round(path.stat().st_size / 1000)}
        if "trainings" in recipe:
            line["trained on"] = f"{len(recipe['trainings'])} trainings' mean, see its card"
        else:
            line["trained on"] = f"{Path(recipe['data']['profile']).name}, {len(recipe['data']['scenes'])} scenes"
            line |= {"budget": recipe.get("budget", "a script"), "step": recipe["step"]}
            line["validation loss"] = f"{recipe['validation']:.4g}"
        lines.append(line | {"SHA-256": file_digest(path)[:12], "licence": WEIGHTS_LICENCE})
    return tabulate(lines, "keys", disable_numparse=True)


def card_file(name: str) -> Path:
    """The path of a network's card. Raises BadInput where its weights are not shipped."""
    return require_shipped(name).with_suffix(".md")


def measured_file(name: str) -> Path:
    """The path of the measurements that its card shows. Raises BadInput where its weights are not shipped."""
    return require_shipped(name).with_suffix(".json")


def measure_card(name: str, runs: Path) -> Path:
    """Extract a network's measurements from RUNS/eval to JSON and regenerate what stands between its card's markers.

    Returns the card's path. Raises BadInput if there is no card yet, or if RUNS/eval has no results of these weights.
    """
    path = card_file(name)
    text = path.read_text() if path.exists() else ""
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise BadInput(
            f"{path}: write the network's intended use and limitations, with the lines '{BEGIN}' and '{END}' where "
            "its facts belong"
        )
    write_json(measured_file(name), measurements(name, runs))
    write_file(path, f"{before}{begin}\n{facts(name)}\n{end}{after}".encode())
    return path


def measurements(name: str, runs: Path) -> dict[str, Any]:
    """The measurements of RUNS/eval that a card shows, see `evaluated_clips`: tables are lists of rows of text."""
    results, clips = evaluated_clips(name, runs)
    alike = of_one_spp(clips)
    return {
        "clips": len(alike),
        "datasets": [Path(each).name for each in results["dataset"].split(", ")],
        "signal": clips[0].signal,
        "precision": results_of(clips, name)[0].precision,
        "device": results["device"],
        "versions": version_list(results["versions"]),
        "means": [
            {"denoiser": row.denoiser, "made from": row.made_from}
            | {METRICS[metric].title: row.text(metric) for metric in PRINTED}
            for row in mean_rows(alike)
        ],
        "psnr": [
            {"clip": f"{clip.scene}/{clip.clip}"} | {row.denoiser: row.text("psnr") for row in clip_rows(clip)}
            for clip in clips
        ],
    }


def facts(name: str) -> str:
    """The generated part of a card as Markdown."""
    weights = require_shipped(name)
    measured = read_json(measured_file(name))
    metadata = read_metadata(weights)
    recipe = metadata["recipe"]
    return (
        FACTS.read_text()
        .strip()
        .format(
            **{key: measured[key] for key in ("signal", "precision", "device", "versions")},
            parameters=recipe["parameters"],
            bytes=weights.stat().st_size,
            digest=file_digest(weights),
            licence=WEIGHTS_LICENCE,
            training=mean_of(recipe["trainings"]) if "trainings" in recipe else training(name, recipe),
            makers=" and ".join(
                f"{version_list(maker['versions'])}, code {maker['code']}" for maker in metadata["made_by"]
            ),
            count=measured["clips"],
            dataset="`, `".join(measured["datasets"]),
            means=tabulate(measured["means"], "keys", "github", disable_numparse=True),
            metric=METRICS["psnr"].title,
            clips=tabulate(measured["psnr"], "keys", "github", disable_numparse=True),
            legend=LEGEND,
        )
    )


def training(name: str, recipe: dict[str, Any]) -> str:
    """The lines of a card on the only training, which has no budget where a script did it."""
    command = "a script that is not kept ([campaign](../../train/campaign/README.md))"
    if "budget" in recipe:
        command = f"`onespp train {name} --budget {recipe['budget']} --seed {recipe['seed']}`"
    start = f", starting from weights of SHA-256 `{recipe['from']}`" if "from" in recipe else ""
    rest = {key: value for key, value in recipe.items() if key not in LISTED_APART}
    return f"""\
- Trained by {command}
  on {dataset(recipe["data"])}{start}.
  Weights of step {recipe["step"]}, with a validation loss of {recipe["validation"]:.4g}.
- Recipe: `{json.dumps(rest)}`."""


def mean_of(trainings: Sequence[dict[str, Any]]) -> str:
    """The lines of a card on the trainings whose weights were averaged."""
    lines = [f"- The mean of the weights of {len(trainings)} trainings, by these recipes:"]
    for each in trainings:
        rest = {key: value for key, value in each.items() if key not in ("data", "parameters")}
        lines.append(f"  - on {dataset(each['data'])}: `{json.dumps(rest)}`")
    return "\n".join(lines)


def dataset(data: dict[str, Any]) -> str:
    """What was trained on."""
    facts = f"seed {data['seed']}, generator version {data['generator']}, {len(data['scenes'])} scenes"
    return f"the data set `{Path(data['profile']).name}` ({facts})"


def version_list(versions: dict[str, str]) -> str:
    return ", ".join(f"{package} {version}" for package, version in versions.items())


def evaluated_clips(name: str, runs: Path) -> tuple[dict[str, Any], list[ClipResults]]:
    """The content of RUNS/eval/results.json, and the results of the network and of its baselines.

    Raises BadInput unless the network was evaluated with the shipped weights as they are now, without --first-hits.
    """
    weights = require_shipped(name)
    wanted = (*baselines(), name)
    path = runs / "eval" / RESULTS_FILE
    content, clips = read_results(runs)
    evaluated = [clip for clip in clips if results_of([clip], name)]
    files = {Path(row["weights"]).name for row in content["rows"] if row["denoiser"] == name}
    stale = files != {weights.name} or path.stat().st_mtime < weights.stat().st_mtime
    if not of_one_spp(evaluated) or stale or content.get("first_hits"):
        command = f"onespp eval {' '.join(wanted)} --runs {runs}"
        raise BadInput(
            f"{path} has no results of {weights} as it is now, on clips at 1 spp without --first-hits: run `{command}`"
        )
    return content, [replace(clip, results=[r for r in clip.results if r.denoiser in wanted]) for clip in evaluated]
