"""Threads for compiled kernels that release the interpreter lock."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import pairwise

import torch

_pool: ThreadPoolExecutor | None = None


def split(work: Callable[[int, int], object], count: int, grain: int) -> None:
    """Call ``work(low, high)`` on consecutive shares of ``range(count)``, one a thread.

    As many threads as torch may use (``torch.set_num_threads``, ``OMP_NUM_THREADS``), this one among them; fewer where
    a share would be smaller than ``grain``. An own pool, since the OpenMP pool belongs to torch and numba's is not safe
    to enter from two threads.

    Args:
        work: releases the interpreter lock; shares may run in any order, so they must not touch the same results.
        count: number of items.
        grain: smallest number of items worth a thread.
    """
    shares = max(1, min(torch.get_num_threads(), count // max(grain, 1)))
    if shares == 1:
        work(0, count)
        return
    edges = [count * i // shares for i in range(shares + 1)]
    others = [_executor().submit(work, low, high) for low, high in pairwise(edges[1:])]
    work(0, edges[1])
    for other in others:
        other.result()


@contextmanager
def at_most(count: int) -> Iterator[None]:
    """Let torch and :func:`split` use at most ``count`` threads inside the block, and as many as before after it."""
    before = torch.get_num_threads()
    torch.set_num_threads(max(1, min(before, count)))
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _executor() -> ThreadPoolExecutor:
    global _pool
    if _pool is None:
        _pool = ThreadPoolExecutor(max(1, (os.cpu_count() or 2) - 1), thread_name_prefix="neurad-kernels")
    return _pool


def _forget() -> None:
    """A forked child has no threads: let it start its own pool."""
    global _pool
    _pool = None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)
