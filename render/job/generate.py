"""The rendering job: renders the missing clips of a dataset."""

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from datasets.card import write_card
from datasets.channels import USUAL_CHANNELS
from datasets.clip import Dataset, is_clip
from errors import BadInput
from files import read_json, write_json
from provenance import RENDERING, versions
from render.clip import NO_OPTIONS, Options
from render.job.clip_job import ClipOutcome, RenderJob, run_clip_job
from render.job.pilots import choose_rooms
from render.job.plan import NO_PILOTS, plan
from render.job.profiles import profile_of


@dataclass(frozen=True)
class Share:
    """Share `index` (from 1) of `count` disjoint shares of a dataset's clips."""

    index: int
    count: int

    @staticmethod
    def parse(text: str) -> "Share":
        """The share written as "K/N". Raises BadInput unless 1 <= K <= N."""
        match = re.fullmatch(r"(\d+)/(\d+)", text)
        if match and 1 <= int(match[1]) <= int(match[2]):
            return Share(int(match[1]), int(match[2]))
        raise BadInput(f"'{text}' is not a share: write K/N with K from 1 to N, such as 2/8")

    def of(self, clips: Sequence[Path]) -> Sequence[Path]:
        return clips[self.index - 1 :: self.count]


WHOLE_DATASET = Share(1, 1)


def render_here(jobs: Sequence[RenderJob]) -> Iterator[ClipOutcome]:
    return map(run_clip_job, jobs)


def generate(
    root: Path,
    profile: str,
    seed: int,
    share: Share = WHOLE_DATASET,
    reads: Sequence[str] = USUAL_CHANNELS,
    options: Options = NO_OPTIONS,
    render: Callable[[Sequence[RenderJob]], Iterator[ClipOutcome]] = render_here,
) -> int:
    """Render the missing clips of a share of the dataset at `root`. Returns how many were rendered.

    Clips for training and validation get the channels in `reads` and the essential ones.

    Several jobs may work on one folder; each clip is rendered by one of them. Folders of disjoint shares can be merged.
    A clip that fails is skipped. A complete dataset gets its card.

    Raises BadInput at the end, naming the first clip that failed, and OSError (such as a full disk) at once.
    """
    if seed < 0:
        raise BadInput(f"the seed {seed} is negative: use 0 or more")
    check_folder(root)
    facts = root / "dataset.json"
    if facts.exists():  # its rooms are chosen; write_or_check_plan compares the profile
        needed_spp = read_json(facts).get("needed_spp", {})
    else:
        needed_spp = choose_rooms(profile_of(profile), seed, options, NO_PILOTS)
    wanted = plan(profile, seed, reads, options, needed_spp)
    for note in wanted["notes"]:
        tqdm.write(note)
    root.mkdir(parents=True, exist_ok=True)
    write_or_check_plan(root, wanted)
    dataset = Dataset(root)

    def job(clip: Path) -> RenderJob:
        channels = tuple(wanted["channels"][clip.parts[-3]])
        return RenderJob(clip, profile, seed, channels, options, needed_spp.get("/".join(clip.parts[-3:])))

    jobs = [job(clip) for clip in share.of(dataset.planned()) if not is_clip(clip)]
    rendered = 0
    if jobs:
        check_versions(dataset)
        rendered = count_rendered(tqdm(render(jobs), "clips", len(jobs), unit="clip"))
    write_card(dataset)
    return rendered


def check_folder(root: Path) -> None:
    """Raise BadInput unless `root` is a new or empty folder, or that of a dataset."""
    if root.exists() and not root.is_dir():
        raise BadInput(f"{root} is a file, not a folder: choose another --data")
    visible = [path.name for path in root.glob("[!.]*")]
    if visible and "dataset.json" not in visible:
        raise BadInput(f"{root} contains something other than a dataset: choose an empty or new folder")


def write_or_check_plan(root: Path, wanted: dict[str, Any]) -> None:
    """Write the plan into a new dataset's folder. Raises BadInput if it contains another plan."""
    if not (root / "dataset.json").exists():
        write_json(root / "dataset.json", wanted)
        return
    present = read_json(root / "dataset.json")
    for key in ("schema", "profile", "seed", "generator", "splits", "channels", "options", "source"):
        if present.get(key, {}) != wanted[key]:
            raise BadInput(f"{root} was made with another {key}: choose another --data or delete it")


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


def count_rendered(outcomes: Iterable[ClipOutcome]) -> int:
    """Wait for all clips, report those not rendered and count the others. Raises BadInput at the end if any failed."""
    ended = []
    for outcome in outcomes:
        ended.append(outcome)
        if outcome.ending != "rendered":
            failed = "failed, the others continue: " if outcome.ending == "failed" else ""
            tqdm.write(f"{outcome.path}: {failed}{outcome.reason}")
    failures = [outcome for outcome in ended if outcome.ending == "failed"]
    if failures:
        first = f"first {failures[0].path}: {failures[0].reason}"
        raise BadInput(f"{len(failures)} of {len(ended)} clips failed and can be tried again, {first}")
    return sum(outcome.ending == "rendered" for outcome in ended)
