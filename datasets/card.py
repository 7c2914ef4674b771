"""The data set card: what a data set is, how it was made, how clean its references are, its licence and hashes."""

import json
from pathlib import Path
from typing import Any

from tabulate import tabulate

from datasets.channels import CHANNELS, USUAL_CHANNELS
from datasets.clip import Clip, Dataset, is_clip
from datasets.tonemap import psnr
from errors import BadInput
from files import write_file

CARD_FILE = "card.json"
PAGE_FILE = "README.md"
PAGE_TEXT = Path(__file__).with_suffix(".md")  # with names in braces


def write_card(dataset: Dataset) -> None:
    """Write the card of a data set into its folder, if all its clips are there and it is not written already."""
    if not all(map(is_clip, dataset.planned())):
        return
    card = card_of(dataset)
    for name, text in ((CARD_FILE, json.dumps(card, indent=1) + "\n"), (PAGE_FILE, page_of(card))):
        path = dataset.path / name
        if not path.exists() or path.read_bytes() != text.encode():
            write_file(path, text.encode())


def card_of(dataset: Dataset) -> dict[str, Any]:
    """The card, for JSON. It follows from the data alone: the same data set has the same card anywhere.

    Raises BadInput where a clip is missing or damaged, and for an imported dataset.
    """
    facts = dataset.facts
    if not facts["generator"]:
        raise BadInput(f"{dataset.path} was imported: only datasets that onespp rendered have a card")
    clips = {str(path.relative_to(dataset.path)): clip_facts(Clip(path)) for path in dataset.planned()}
    used = [split for split, names in facts["splits"].items() if names]
    what = f"--scene {Path(facts['profile']).name}" if facts["source"] else f"--profile {facts['profile']}"
    options = "".join(f" --{name}" for name, on in facts["options"].items() if on)
    models = facts.get("models", {})
    options += " --models DIR" if models else ""
    return {
        "profile": Path(facts["profile"]).name,
        "seed": facts["seed"],
        "command": f"onespp dataset {what} --seed {facts['seed']}{options}",
        "generator": facts["generator"],
        "versions": facts["versions"],
        "options": facts["options"],
        "licence": licence_of(facts),
        "source": {Path(path).name: crc32 for path, crc32 in facts["source"].items()},
        "notes": facts["notes"],
        "models": models,
        "scenes": facts["scenes"],
        "bytes": sum(clip["bytes"] for clip in clips.values()),
        "splits": {split: split_facts([clips[f"{split}/{name}"] for name in facts["splits"][split]]) for split in used},
        "channels": {
            name: {
                "axes": list(channel.axes),
                "unit": channel.unit,
                "splits": [split for split in used if name in facts["channels"][split]],
            }
            for name, channel in CHANNELS.items()
            if name in USUAL_CHANNELS or any(name in facts["channels"][split] for split in used)
        },
        "clips": clips,
    }


def licence_of(facts: dict[str, Any]) -> str:
    """Of the images: that of what they show, where it is not ours."""
    if facts["source"]:
        return "that of its scene file"
    return "CC0-1.0, but for pictures of furniture, see below" if facts.get("models") else "CC0-1.0"


def clip_facts(clip: Clip) -> dict[str, Any]:
    """A clip on the card; the keys are also the columns of the page."""
    stored = [clip.path / entry["file"] for entry in clip.channels.values() if "file" in entry]
    return {
        "frames": clip.frames,
        "width": clip.width,
        "height": clip.height,
        "noisy_spp": clip.facts["noisy_spp"],
        "realisations": clip.realisations,
        "reference_spp": clip.facts["reference_spp"],
        "floor_db": round(psnr(clip.facts["floor_mse"]), 2),
        "bytes": sum(path.stat().st_size for path in [*stored, clip.path / "clip.json"]),
        "crc32": clip.fingerprint,
    }


def split_facts(clips: list[dict[str, Any]]) -> dict[str, Any]:
    floors = [clip["floor_db"] for clip in clips]
    return {
        "clips": len(clips),
        "frames": sum(clip["frames"] for clip in clips),
        "floor_db": round(sum(floors) / len(floors), 2),
        "worst_floor_db": min(floors),
    }


def page_of(card: dict[str, Any]) -> str:
    options = [name for name, on in card["options"].items() if on]
    left_out = [name for name, channel in card["channels"].items() if channel["splits"] != list(card["splits"])]
    splits = [{"split": split, **facts} for split, facts in card["splits"].items()]
    channels = [
        [name, ", ".join(map(str, channel["axes"])), channel["unit"], ", ".join(channel["splits"])]
        for name, channel in card["channels"].items()
    ]
    rows = [{"clip": name, **clip} for name, clip in card["clips"].items()]
    return PAGE_TEXT.read_text().format(
        **{key: card[key] for key in ("profile", "seed", "command", "generator", "licence", "bytes")},
        clips=len(card["clips"]),
        versions=", ".join(f"{name} {version}" for name, version in card["versions"].items()),
        reads=f" Only test clips have {', '.join(left_out)} (`--reads`)." if left_out else "",
        options=", ".join(options) or "none",
        notes="".join(f"\n- Not as in the scene file: {note}." for note in card["notes"])
        + "".join(f"\n- With {credit}." for credit in card["models"].get("credits", [])),
        splits=tabulate(splits, "keys", "github", disable_numparse=True),
        channels=tabulate(channels, ["channel", "axes", "unit", "in"], "github"),
        rows=tabulate(rows, "keys", "github", disable_numparse=True),
    )
