"""The one timer, with a clock of its own: no test asserts real time."""

import pytest
import torch

from timing import take_turns, thread_count


class Clock:
    """A clock that only `work` advances."""

    def __init__(self) -> None:
        self.now = 0.0
        self.calls: list[str] = []

    def work(self, name: str, seconds: float):
        def run() -> None:
            self.calls.append(name)
            self.now += seconds

        return run

    def __call__(self) -> float:
        return self.now


def test_functions_take_turns_after_warm_up():
    clock = Clock()
    rounds = []

    def prepare(number: int) -> None:
        rounds.append(number)
        clock.now += 9.0  # which does not count

    work = {"a": clock.work("a", 1.0), "b": clock.work("b", 2.0)}
    seconds = take_turns(work, measured=3, warm_up=2, before_round=prepare, clock=clock)
    assert clock.calls == ["a", "b"] * 5 and rounds == [0, 1, 2, 3, 4]
    assert seconds == {"a": [1.0] * 3, "b": [2.0] * 3}


@pytest.mark.parametrize(("patience", "rounds"), [(0.0, 2), (1e9, 10)])
def test_patience_ends_after_the_minimum_of_rounds(patience, rounds):
    clock = Clock()
    seconds = take_turns({"a": clock.work("a", 1.0)}, measured=10, fewest=2, patience=patience, clock=clock)
    assert len(seconds["a"]) == rounds


def test_the_thread_count_is_restored_after_an_error():
    before = torch.get_num_threads()
    with pytest.raises(KeyError), thread_count(1):
        assert torch.get_num_threads() == 1
        raise KeyError
    assert torch.get_num_threads() == before
