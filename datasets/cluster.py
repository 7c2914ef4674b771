"""Rendering clips on a Ray cluster: many machines, one shared folder, and a lost worker costs one clip."""

import os
import signal
import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from datasets.clip import Dataset
from datasets.generate import ClipJob, Outcome, check_versions, render_clip_job
from errors import BadInput
from render.backend import VARIANT, dr

TRIES = 4  # of a clip whose worker dies
PATIENCE = 10  # seconds that workers have to clean up when the job is given up


@contextmanager
def uninterrupted() -> Iterator[None]:
    """The first Ctrl-C takes effect at the end: in the middle of Ray's start it would crash the process."""
    came = False
    usual = signal.getsignal(signal.SIGINT)

    def wait(*_: object) -> None:
        nonlocal came
        came = True
        signal.signal(signal.SIGINT, usual)

    signal.signal(signal.SIGINT, wait)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, usual)
    if came:
        raise KeyboardInterrupt


@contextmanager
def connected() -> Iterator[Any]:
    """The ray module, connected to the cluster that RAY_ADDRESS names or that runs here, else to one of this machine.

    Raises BadInput where Ray is not installed, or no cluster answers.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # Ray reports to its makers otherwise
    try:
        import ray
    except ImportError:
        raise BadInput("--ray needs Ray: pip install 'onespp[ray]'") from None
    try:
        with uninterrupted():
            start(ray)
        yield ray
    finally:
        ray.shutdown()


def start(ray: Any) -> None:
    host, _, port = os.environ.get("RAY_ADDRESS", "").rpartition(":")
    try:
        if port.isdigit():
            socket.create_connection((host, int(port)), timeout=5).close()  # Ray itself would try for minutes
        ray.init(include_dashboard=False, log_to_driver=False, logging_level="error")
    except (OSError, RuntimeError, ValueError) as error:
        raise BadInput(
            f"no Ray cluster answers ({error}): check RAY_ADDRESS and RAY_AUTH_MODE, or end a broken one by `ray stop`"
        ) from None


def requirements() -> dict[str, Any]:
    """What a clip's task reserves: a GPU where this machine renders on one, else one core, with GPUs out of sight.

    All clips of a data set are rendered by the variant that this machine renders with, or their bytes would differ.
    """
    if VARIANT.startswith("cuda"):
        return {"num_cpus": 1, "num_gpus": 1}
    return {"num_cpus": 1, "runtime_env": {"env_vars": {"CUDA_VISIBLE_DEVICES": ""}}}


def render_on_worker(job: ClipJob) -> Outcome:
    """What a worker does. On one core, as it has reserved: clips side by side use all cores better than threads do."""
    dr.set_thread_count(1)
    check_versions(Dataset(job.path.parents[2]))
    return render_clip_job(job)


def render_on_cluster(jobs: Sequence[ClipJob]) -> Iterator[Outcome]:
    """Render clips on a Ray cluster; yields their outcomes in the order in which they end.

    Every clip has a worker process of its own, and is tried again in another where that dies. All machines must reach
    the clips' folder under the same path. Raises OSError and BadInput of a worker at once, giving the rest up.
    """
    with connected() as ray:
        if VARIANT.startswith("cuda") and not ray.cluster_resources().get("GPU"):
            raise BadInput("this machine renders on its GPU and the cluster has none: set CUDA_VISIBLE_DEVICES=''")
        task = ray.remote(max_calls=1, max_retries=TRIES - 1, **requirements())(render_on_worker)
        tasks = {task.remote(job._replace(path=job.path.absolute())): job for job in jobs}
        waiting = list(tasks)
        try:
            while waiting:
                [done], waiting = ray.wait(waiting)
                yield outcome_of(ray, done, tasks[done])
        finally:
            for unfinished in waiting:
                ray.cancel(unfinished)  # interrupts Python in the worker, which then removes what it has begun
            if waiting:
                ray.wait(waiting, num_returns=len(waiting), timeout=PATIENCE)


def outcome_of(ray: Any, reference: Any, job: ClipJob) -> Outcome:
    """The outcome of an ended task. Raises what the worker raised."""
    try:
        return ray.get(reference)._replace(path=job.path)
    except ray.exceptions.RayTaskError as error:
        raise error.cause from error
    except ray.exceptions.RayError as error:  # the worker died, or its machine
        return Outcome(job.path, "failed", f"{TRIES} workers died: {str(error).splitlines()[0]}")
