"""Threads for work that releases the interpreter lock: compiled kernels and torch's matrix products.

Torch's own threads wait for work by spinning for a while, so other threads get no core beside them. Where torch has no
work for several threads, it runs on the calling thread and leaves the others to what is split here.
"""

import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from itertools import pairwise
from typing import TypeVar

import torch

T = TypeVar("T")
S = TypeVar("S")

_here = threading.local()
_pool: ThreadPoolExecutor | None = None
_allowed: int | None = None


def split(work: Callable[[int, int], T], count: int, grain: int) -> list[T]:
    """Call ``work(low, high)`` on consecutive ranges of ``range(count)``, one a thread; their results in order.

    As many threads as torch may use (``torch.set_num_threads``, ``OMP_NUM_THREADS``) outside :func:`torch_on_one`, this
    one among them; fewer where an even range would be smaller than ``grain``. The ranges are those of :func:`cut`. It
    has a pool of its own, since the OpenMP pool belongs to torch and numba's is not safe to enter from two threads.
    Handing a range over takes 50 microseconds.

    Args:
        work: releases the interpreter lock; ranges may run in any order, so they must not write to the same results.
            What it splits itself is done by its own thread.
        grain: smallest number of items worth a thread.
    """
    parts = 1 if getattr(_here, "splits", False) else threads(count, grain)
    if parts == 1:
        return [work(0, count)]
    edges = cut(count, parts, grain)
    others = [_executor().submit(_as_part, work, low, high) for low, high in pairwise(edges[1:])]
    return [_as_part(work, 0, edges[1]), *(other.result() for other in others)]


def _as_part(work: Callable[[int, int], T], low: int, high: int) -> T:
    """``work(low, high)``, which splits nothing itself: threads that wait for their own pool would wait for ever."""
    _here.splits = True
    try:
        return work(low, high)
    finally:
        _here.splits = False


def cut(count: int, parts: int, grain: int) -> list[int]:
    """Edges of ``parts`` consecutive ranges of ``range(count)``: where each begins, and the end.

    The first is for the calling thread and larger by half of a ``grain``, about what is done while another thread
    wakes: it is better off working than waiting (a step of 16384 samples is 7 % shorter).
    """
    ahead = min(grain // 2, count // 2) if parts > 1 else 0
    return [0, *(ahead + (count - ahead) * i // parts for i in range(1, parts + 1))]


GRAIN = 4096
"""Lanes of a plain compiled pass that are worth a thread: about 0.1 ms of work."""


def threads(count: int, grain: int) -> int:
    """How many threads :func:`split` uses for ``count`` items, ``grain`` at least a thread."""
    return max(1, min(_allowed or torch.get_num_threads(), count // max(grain, 1)))


@contextmanager
def torch_on_one() -> Iterator[None]:
    """Inside the block torch uses the calling thread alone, and :func:`split` as many as torch did before."""
    global _allowed
    before = torch.get_num_threads(), _allowed
    _allowed = _allowed or before[0]
    torch.set_num_threads(1)
    try:
        yield
    finally:
        _allowed = before[1]
        torch.set_num_threads(before[0])


@contextmanager
def at_most(count: int) -> Iterator[None]:
    """Let torch and :func:`split` use at most ``count`` threads inside the block, and as many as before after it."""
    global _allowed
    before, allowed = torch.get_num_threads(), _allowed
    torch.set_num_threads(max(1, min(before, count)))
    _allowed = None if allowed is None else max(1, min(allowed, count))
    try:
        yield
    finally:
        _allowed = allowed
        torch.set_num_threads(before)


def parallel_map(work: Callable[[S], T], items: Iterable[S]) -> Iterator[T]:
    """``work(item)`` of every item in order, as many at a time as torch may use threads, each on one thread alone.

    For work that is large enough to be one thread's, for which :func:`split` would hand over parts too small.

    Args:
        work: holds the interpreter lock for a small part of its time only; it runs with gradients off, since the mode
            of the caller is not that of other threads.
        items: drawn by the calling thread, no more of them at a time than are worked on.
    """
    count = max(1, _allowed or torch.get_num_threads())

    def alone(item: S) -> T:
        with torch.no_grad():
            return work(item)

    if count == 1:
        yield from map(alone, items)
        return
    running: deque[Future[T]] = deque()
    with at_most(1), ThreadPoolExecutor(count, "neurad-each", torch.set_num_threads, (1,)) as pool:
        for item in items:
            running.append(pool.submit(alone, item))
            if len(running) > count:
                yield running.popleft().result()
        while running:
            yield running.popleft().result()


def _executor() -> ThreadPoolExecutor:
    global _pool
    if _pool is None:
        workers = max(1, (os.cpu_count() or 2) - 1)
        _pool = ThreadPoolExecutor(workers, "neurad-kernels", initializer=torch.set_num_threads, initargs=(1,))
    return _pool


def _forget() -> None:
    """A forked child has no threads: let it start its own pool."""
    global _pool
    _pool = None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)
