"""The rendering job: renders the missing clips of a dataset."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm

from datasets.card import write_card
from datasets.channels import SECOND_LAYER, USUAL_CHANNELS
from datasets.clip import ClipKind, Dataset, is_clip
from errors import BadInput
from files import locked, read_json, write_json
from provenance import RENDERING, versions
from render.clip import NO_OPTIONS, Options, Sampling, timed, write_clip
from render.job.pilots import choose_rooms, samples_needed
from render.job.plan import plan, rarity_of_clip, scene_of_clip
from render.job.profiles import DataProfile, profile_of
from render.scene_file.load import TRACED


def share_of(clips: Sequence[Path], part: str) -> Sequence[Path]:
    """Share K of N disjoint shares of clips, for a `part` "K/N". Raises BadInput unless 1 <= K <= N."""
    match = re.fullmatch(r"(\d+)/(\d+)", part)
    if match and 1 <= int(match[1]) <= int(match[2]):
        return clips[int(match[1]) - 1 :: int(match[2])]
    raise BadInput(f"'{part}' is not a share: write K/N with K from 1 to N, such as 2/8")


def generate(
    root: Path,
    profile: str,
    seed: int,
    part: str = "1/1",
    reads: Sequence[str] = USUAL_CHANNELS,
    options: Options = NO_OPTIONS,
    models: str = "",
) -> int:
    """Render the missing clips of the dataset at `root`, or of `part` "K/N" of them. Returns how many were rendered.

    Clips for training and validation get the channels in `reads` and the essential ones, and their rooms are furnished
    from the furniture libraries in the folder `models`, if it is not empty.

    Several jobs may work on one folder; each clip is rendered by one of them. Folders of disjoint parts can be merged.
    A clip that fails is skipped. A complete dataset gets its card.

    Raises BadInput at the end, naming the first clip that failed, and OSError (such as a full disk) at once.
    """
    if seed < 0:
        raise BadInput(f"the seed {seed} is negative: use 0 or more")
    share_of([], part)
    dataset = begun(root, profile, seed, reads, options, models)
    missing = [clip for clip in share_of(dataset.planned(), part) if not is_clip(clip)]
    rendered = render_clips(missing, dataset, models) if missing else 0
    write_card(dataset)
    return rendered


def begun(root: Path, profile: str, seed: int, reads: Sequence[str], options: Options, models: str = "") -> Dataset:
    """The dataset of that plan at `root`, which may be new.

    Raises BadInput if `root` contains anything but a dataset, or one of another plan.
    """
    if root.exists() and not root.is_dir():
        raise BadInput(f"{root} is a file, not a folder: choose another --data")
    visible = [path.name for path in root.glob("[!.]*")]
    if visible and "dataset.json" not in visible:
        raise BadInput(f"{root} contains something other than a dataset: choose an empty or new folder")
    facts = root / "dataset.json"
    if facts.exists():  # its rooms are chosen
        needed_spp = read_json(facts).get("needed_spp", {})
    else:
        needed_spp = choose_rooms(profile_of(profile, models), seed, options)
    wanted = plan(profile, seed, reads, options, needed_spp, models)
    for note in wanted["notes"]:
        tqdm.write(note)
    root.mkdir(parents=True, exist_ok=True)
    if not facts.exists():
        write_json(facts, wanted)
    dataset = Dataset(root)
    # Notes, too: a texture that was missing may have come.
    for key in ("profile", "seed", "generator", "models", "splits", "channels", "options", "source", "notes"):
        if portable(key, dataset.facts.get(key, {})) != portable(key, wanted[key]):
            other = "other" if key.endswith("s") else "another"
            raise BadInput(f"{root} was made with {other} {key}: choose another --data or delete it")
    if dataset.facts["profile"] != profile:  # the TOML has moved
        dataset.facts["profile"] = profile
        write_json(facts, dataset.facts)
    return dataset


def portable(key: str, value: Any) -> Any:
    """A fact of a dataset without what differs between folders, and machines that trace other paths."""
    if key == "profile":
        return Path(value).name
    return [note for note in value if TRACED not in note] if key == "notes" else value


def check_versions(dataset: Dataset) -> None:
    """Raise BadInput if the dataset was begun with other versions of packages, which may render other bytes."""
    here = versions(RENDERING)
    changed = [
        f"{name} {began_with}, here {here.get(name, 'none')}"
        for name, began_with in dataset.facts["versions"].items()
        if here.get(name) != began_with
    ]
    if changed:
        raise BadInput(f"{dataset.path} was begun with {'; '.join(changed)}: install those or start a new folder")


def render_clips(clips: Sequence[Path], dataset: Dataset, models: str = "") -> int:
    """Render clips unless other processes render them or have done so. Returns how many were rendered.

    Reports the others. Raises BadInput at the end if the renderer failed for any, OSError at once: a full disk concerns
    all clips.
    """
    check_versions(dataset)
    facts = dataset.facts
    profile = profile_of(facts["profile"], models)
    seed, options = facts["seed"], Options(**facts["options"])
    rendered, failures = 0, []
    for clip in tqdm(clips, "clips", unit="clip"):
        clip.parent.mkdir(parents=True, exist_ok=True)
        with locked(clip.with_name(f".{clip.name}.lock")) as ours:
            if not ours or is_clip(clip):
                tqdm.write(f"{clip}: skipped: another process {'has rendered' if ours else 'is rendering'} it")
                continue
            split = clip.parts[-3]
            needed_spp = facts.get("needed_spp", {}).get("/".join(clip.parts[-3:]))
            try:
                render_to_folder(clip, profile, seed, facts["channels"][split], options, needed_spp)
                rendered += 1
            except (RuntimeError, ValueError) as error:
                tqdm.write(f"{clip}: failed, the others continue: {error}")
                failures.append(f"{clip}: {error}")
    if failures:
        raise BadInput(f"{len(failures)} of {len(clips)} clips failed and can be tried again, first {failures[0]}")
    return rendered


def render_to_folder(
    folder: Path,
    profile: DataProfile,
    dataset_seed: int,
    channels: Sequence[str],
    options: Options = NO_OPTIONS,
    needed_spp: int | None = None,
) -> None:
    """Render channels of the clip in the folder DATA/SPLIT/SCENE/CLIP, completely or not at all.

    By default a pilot predicts `needed_spp`, the samples a pixel that references need. The clip is deterministic in the
    arguments. Raises BadInput for an unknown scene or clip name.
    """
    split, _, clip_name = folder.parts[-3:]
    quality = profile.quality[split]
    scene, seed = scene_of_clip(folder, profile, dataset_seed)
    seconds: dict[str, float] = {}
    if needed_spp is None:
        with timed(seconds, "pilot"):
            needed_spp = samples_needed(scene, profile.size, quality, seed, options)
    spp = min(needed_spp, max(quality.reference_spp, quality.most_spp))
    judged = profile.judged if split == "test" else ()
    noisy_spp = ClipKind.of(clip_name).noisy_spp
    rarity = rarity_of_clip(seed, quality.rarest)
    sampling = Sampling(quality.realisations, noisy_spp, spp, options, judged, rarity)
    layers = SECOND_LAYER if split == "test" else ()  # networks are trained on one layer of glass
    write_clip(folder, scene, profile.size, sampling, seed, (*channels, *layers), seconds)
