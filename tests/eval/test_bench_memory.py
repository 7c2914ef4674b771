"""Memory is measured in processes that leave nothing behind."""

import multiprocessing
import os
import subprocess
import sys
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import numpy as np
import pytest

from eval.bench.memory import alone, growth_mb, status_mb

LOCKS = """
import multiprocessing
from eval.bench.memory import alone

def take_lock():
    global lock
    lock = multiprocessing.RLock()  # as Numba does when it starts its threads; its semaphore has a name here
    return lock.acquire()

if __name__ == "__main__":
    print([alone(take_lock) for _ in range(3)])
"""


@pytest.mark.slow
def test_no_semaphore_is_leaked(tmp_path):
    """Python's resource tracker would complain after the end, on standard error."""
    script = tmp_path / "locks.py"
    script.write_text(LOCKS)
    environment = os.environ | {"PYTHONPATH": str(Path.cwd())}
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, env=environment)
    assert (done.stdout, done.stderr) == ("[True, True, True]\n", "")


def test_every_call_has_a_process_of_its_own():
    assert len({os.getpid(), alone(os.getpid), alone(os.getpid)}) == 3
    assert not multiprocessing.active_children()


def test_a_process_that_dies_is_an_error():
    with pytest.raises(BrokenProcessPool):
        alone(os._exit, 1)


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="Linux only")
def test_growth_is_that_of_touched_memory():
    megabytes = growth_mb(lambda: np.ones(20_000_000))  # 160 MB
    assert 150 < megabytes < 180
    assert growth_mb(lambda: None) < 20
    now = status_mb("VmRSS")
    assert status_mb("VmHWM") >= now > 0
    assert status_mb("VmNothing") is None
