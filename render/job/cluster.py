"""Rendering clips on a Ray cluster: machines share one folder, and a lost worker costs one clip."""

import os
import signal
import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from datasets.clip import Dataset
from errors import BadInput
from render.backend import MIN_THREADS, VARIANT, dr
from render.job.clip_job import ClipOutcome, RenderJob, run_clip_job
from render.job.generate import check_versions

MAX_WORKERS_PER_CLIP = 4  # that may die before the clip counts as failed
CLEAN_UP_SECONDS = 10  # for workers of an interrupted job


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Delays the first Ctrl-C to the end of the context: it would crash the process while Ray starts."""
    interrupted = False
    previous = signal.getsignal(signal.SIGINT)

    def delay(*_: object) -> None:
        nonlocal interrupted
        interrupted = True
        signal.signal(signal.SIGINT, previous)

    signal.signal(signal.SIGINT, delay)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)
    if interrupted:
        raise KeyboardInterrupt


@contextmanager
def connected_ray() -> Iterator[Any]:
    """The ray module, connected to the cluster of RAY_ADDRESS, a local one, or a new local one.

    Raises BadInput if Ray is not installed, or no cluster answers.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # no telemetry
    try:
        import ray
    except ImportError:
        raise BadInput("--ray needs Ray: pip install 'onespp[ray]'") from None
    try:
        with uninterrupted():
            connect(ray)
        yield ray
    finally:
        ray.shutdown()


def connect(ray: Any) -> None:
    """Connect to a cluster or start one on this machine. Raises BadInput if that of RAY_ADDRESS does not answer."""
    host, _, port = os.environ.get("RAY_ADDRESS", "").rpartition(":")
    try:
        if port.isdigit():
            socket.create_connection((host, int(port)), timeout=5).close()  # Ray itself would try for minutes
        ray.init(include_dashboard=False, log_to_driver=False, logging_level="error")
    except (OSError, RuntimeError, ValueError) as error:
        remedy = "check RAY_ADDRESS and RAY_AUTH_MODE, or end a broken one by `ray stop`"
        raise BadInput(f"no Ray cluster answers ({error}): {remedy}") from None


def reserved_resources() -> dict[str, Any]:
    """Resources for a clip's task: a GPU if this machine renders on one, else one core without GPUs.

    All workers must use this machine's Mitsuba variant, because the bytes of others differ.
    """
    if VARIANT.startswith("cuda"):
        return {"num_cpus": 1, "num_gpus": 1}
    return {"num_cpus": 1, "runtime_env": {"env_vars": {"CUDA_VISIBLE_DEVICES": ""}}}


def render_on_worker(job: RenderJob) -> ClipOutcome:
    """Render a clip on few threads: concurrent clips use cores better than threads."""
    dr.set_thread_count(MIN_THREADS)
    check_versions(Dataset(job.path.parents[2]))
    return run_clip_job(job)


def render_on_cluster(jobs: Sequence[RenderJob]) -> Iterator[ClipOutcome]:
    """Render clips on a Ray cluster; yields their outcomes as they end.

    Every clip has a worker process of its own, and a new one if that dies. The clips' folder must have the same path on
    all machines.

    Raises BadInput if there is no usable cluster, and what workers raise: OSError for a full disk, BadInput for other
    versions of packages.
    """
    with connected_ray() as ray:
        if VARIANT.startswith("cuda") and not ray.cluster_resources().get("GPU"):
            raise BadInput("this machine renders on its GPU and the cluster has none: set CUDA_VISIBLE_DEVICES=''")
        yield from outcomes_of(ray, jobs)


def outcomes_of(ray: Any, jobs: Sequence[RenderJob]) -> Iterator[ClipOutcome]:
    """Run all jobs on the cluster to which `ray` is connected, as `render_on_cluster` does."""
    task = ray.remote(max_calls=1, max_retries=MAX_WORKERS_PER_CLIP - 1, **reserved_resources())(render_on_worker)
    tasks = {task.remote(job._replace(path=job.path.absolute())): job for job in jobs}
    waiting = list(tasks)
    try:
        while waiting:
            [done], waiting = ray.wait(waiting)
            job = tasks[done]
            try:
                outcome = ray.get(done)._replace(path=job.path)
            except ray.exceptions.RayTaskError as error:
                raise error.cause from error
            except ray.exceptions.RayError as error:  # the worker died, or its machine
                reason = f"{MAX_WORKERS_PER_CLIP} workers died: {str(error).splitlines()[0]}"
                outcome = ClipOutcome(job.path, "failed", reason)
            yield outcome
    finally:
        for unfinished in waiting:
            ray.cancel(unfinished)  # interrupts the worker, which removes its unfinished clip
        if waiting:
            ray.wait(waiting, num_returns=len(waiting), timeout=CLEAN_UP_SECONDS)
