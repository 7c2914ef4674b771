"""Who reads which items, in what parts."""

from concurrent.futures import ThreadPoolExecutor

import torch
from hypothesis import given
from hypothesis import strategies as st

from timing import thread_count
from train.data import equal_parts, load_ahead, micro_batches


@given(count=st.integers(1, 200), largest=st.integers(1, 250))
def test_parts_are_equal_and_the_fewest(count, largest):
    parts = equal_parts(count, largest)
    assert [i for part in parts for i in part] == list(range(count))
    assert {len(part) for part in parts} == {len(parts[0])} and len(parts[0]) <= largest
    fewer = [n for n in range(1, len(parts)) if count % n == 0 and count // n <= largest]
    assert not fewer


@given(st.sampled_from([1, 2, 4]), st.integers(1, 8), st.integers(0, 3))
def test_processes_share_the_items_of_a_single_process(world, largest, first):
    """Step by step, all processes together read the items of a single one, whatever the parts."""
    batch = 8
    stop = 5
    whole = micro_batches(first, stop, batch, batch)
    assert whole == [list(range(s * batch, (s + 1) * batch)) for s in range(first, stop)]
    parts = len(equal_parts(batch // world, largest))
    shares = [micro_batches(first, stop, batch, largest, rank, world) for rank in range(world)]
    for step, expected in enumerate(whole):
        items = [i for share in shares for part in share[step * parts : (step + 1) * parts] for i in part]
        assert sorted(items) == expected


class Counted:
    """Batches of one item, a number."""

    def batch(self, numbers):
        return numbers[0]


def test_loading_ahead_leaves_the_number_of_threads():
    """That of a thread which has not computed before, as the one that resumes a training of a small network."""

    def threads_after_loading() -> int:
        torch.set_num_threads(3)
        assert list(load_ahead(Counted(), [[1], [2]])) == [1, 2]
        return torch.get_num_threads()

    with thread_count(torch.get_num_threads()), ThreadPoolExecutor(1) as thread:
        assert thread.submit(threads_after_loading).result() == 3
