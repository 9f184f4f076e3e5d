"""Work that is handed to several threads comes back whole and in order, and leaves torch as it was."""

import threading
import time

import pytest
import torch
from helpers.torch_threads import torch_threads

from neurad.runtime import threads


@pytest.fixture(params=[1, 3])
def count(request):
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


def test_each_keeps_the_order_whatever_takes_longest(count):
    def work(item):
        time.sleep(0.02 if item % 3 == 0 else 0.0)
        return item * item

    assert list(threads.parallel_map(work, range(20))) == [item * item for item in range(20)]
    assert torch.get_num_threads() == count


def test_each_uses_as_many_threads_as_torch_may_and_one_for_an_item(count):
    meeting, seen = threading.Barrier(count, timeout=20.0), []

    def work(item):
        meeting.wait()  # passes only where so many items are worked on at a time
        seen.append((torch.get_num_threads(), torch.is_grad_enabled()))

    with torch.enable_grad():
        list(threads.parallel_map(work, range(2 * count)))
    assert seen == [(1, False)] * (2 * count)


def test_each_draws_no_more_than_it_works_on(count):
    drawn = []

    def items():
        for k in range(50):
            drawn.append(k)
            yield k

    results = threads.parallel_map(lambda item: item, items())
    assert next(results) == 0
    assert len(drawn) <= count + 1
    results.close()


def test_what_goes_wrong_in_a_thread_is_said_and_leaves_no_thread_behind(count):
    def work(item):
        if item == 3:
            raise ValueError("item 3")
        return item

    with pytest.raises(ValueError, match="item 3"):
        list(threads.parallel_map(work, range(10)))
    assert torch.get_num_threads() == count
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("neurad-each")]


def test_what_a_part_splits_it_does_itself():
    with torch_threads(4):
        parts = threads.split(lambda low, high: (high - low, threads.split(lambda a, b: b - a, 100, 1)), 400, 1)
        assert sum(size for size, _ in parts) == 400
        assert [inner for _, inner in parts] == [[100]] * 4
        assert len(threads.split(lambda low, high: None, 400, 1)) == 4
