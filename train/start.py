"""The network that a training begins with."""

from datasets.clip import Clip, constant_channels
from errors import BadInput
from models.denoiser import Denoiser
from models.specialise import specialise
from models.weights import load_weights
from train.task import Task


def starting_network(task: Task, clips: list[Clip]) -> Denoiser:
    """The task's network, with fresh weights or those it starts from, specialised to `clips` if the task says so.

    Raises BadInput where those weights cannot be used, or are specialised to other scenes than these, and where a
    network that needs all of its inputs is to be specialised.
    """
    denoiser = task.create()
    if task.start:
        load_weights(denoiser, task.name, task.start)
    constants = constant_channels(clips)
    for name, value in denoiser.constants.items():
        if constants.get(name) != value:
            raise BadInput(
                f"{task.start} is specialised to scenes whose {name} is {value} everywhere, which it is not in "
                f"{task.data.path}: start from general weights"
            )
    if task.specialised:
        if not denoiser.dispensable:
            raise BadInput(f"'{task.name}' cannot do without any of its inputs: train it without --specialise")
        specialise(denoiser, constants)
    return denoiser
