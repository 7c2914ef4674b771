"""Weights on disk: safetensors, with the network's name and training recipe in the metadata."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from errors import BadInput
from files import write_file
from models.denoiser import Denoiser
from provenance import file_digest


def save_weights(
    denoiser: Denoiser, name: str, recipe: dict[str, Any], path: Path, made_by: Sequence[Mapping[str, Any]] = ()
) -> None:
    """Write atomically. `made_by` names the code and packages that trained them, see provenance.MadeBy."""
    tensors = {key: tensor.detach().contiguous().cpu() for key, tensor in denoiser.state_dict().items()}
    metadata = {"denoiser": name, "recipe": json.dumps(recipe), "made_by": json.dumps(list(made_by))}
    if denoiser.constants:
        metadata["constants"] = json.dumps(denoiser.constants)
    write_file(path, save(tensors, metadata))


def read_metadata(path: Path) -> dict[str, Any]:
    """The metadata that `save_weights` wrote: "denoiser", "recipe", "made_by", and "constants"."""
    with safe_open(path, framework="pt") as file:
        metadata = file.metadata() or {}
    return {key: text if key == "denoiser" else json.loads(text) for key, text in metadata.items()}


def average_weights(denoiser: Denoiser, name: str, files: Sequence[Path], path: Path) -> None:
    """Write the mean of the weights of several trainings that had the same start, which may be among them.

    After Wortsman et al. 2022, "Model soups". The recipe lists those of the trainings. Raises BadInput as
    `load_weights` does, for specialised weights, for means, and where the starts differ.
    """
    sums: dict[str, Tensor] = {}
    recipes, made_by = [], []
    for file in files:
        load_weights(denoiser, name, file)
        metadata = read_metadata(file)
        if "constants" in metadata:
            raise BadInput(f"{file} is specialised to one scene: average weights that take all inputs")
        sums = {key: tensor.double() + sums.get(key, 0) for key, tensor in denoiser.state_dict().items()}
        if not {"recipe", "made_by"} <= metadata.keys():
            raise BadInput(f"{file} does not state how it was trained: average weights that `onespp train` wrote")
        if "trainings" in metadata["recipe"]:
            raise BadInput(f"{file} is a mean itself: name the weights of its trainings")
        recipes.append(metadata["recipe"] | {"sha256": file_digest(file)})
        made_by += [maker for maker in metadata["made_by"] if maker not in made_by]
    if not set.intersection(*({recipe["sha256"], recipe.get("from")} for recipe in recipes)) - {None}:
        names = ", ".join(map(str, files))
        raise BadInput(f"{names} did not begin with the same weights: average trainings that had one --from")
    denoiser.load_state_dict({key: total / len(files) for key, total in sums.items()})
    recipe = {"parameters": sum(total.numel() for total in sums.values()), "trainings": recipes}
    save_weights(denoiser, name, recipe, path, made_by)


def load_weights(denoiser: Denoiser, name: str, path: Path) -> None:
    """Load a file, specialised as its metadata states. Raises BadInput if missing, damaged or of another network."""
    if not path.exists():
        raise BadInput(f"there are no weights at {path}: train them with `onespp train {name}`")
    if path.is_dir():
        raise BadInput(f"{path} is a folder: name the file of weights in it")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 - not a dict
    except (SafetensorError, OSError) as error:
        raise BadInput(f"{path} is damaged or not a safetensors file ({error})") from None
    if metadata.get("denoiser") != name:
        raise BadInput(f"{path} holds weights of '{metadata.get('denoiser')}', not of '{name}'")
    denoiser.specialise(json.loads(metadata.get("constants", "{}")))
    try:
        denoiser.load_state_dict(tensors)
    except RuntimeError:
        raise BadInput(f"{path} holds a '{name}' of another shape: train it again with `onespp train {name}`") from None
