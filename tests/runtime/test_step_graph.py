"""When work is captured, replayed and given up. Graphs are played by objects that do the work again."""

from contextlib import contextmanager

import pytest
import torch

from neurad.runtime import step_graph
from neurad.runtime.step_graph import WARM_UP, StepGraph


class Graph:
    """Does what was captured by it again."""

    def __init__(self):
        self.generators, self.again = [], None

    def register_generator_state(self, generator):
        self.generators.append(generator)

    def replay(self):
        self.again()


class Work:
    """Random numbers into a tensor that stays, as a captured kernel would write them."""

    def __init__(self, generator):
        self.generator, self.done, self.out, self.noise = generator, 0, torch.zeros(3), 0.0

    def __call__(self):
        self.done += 1
        self.out.copy_(torch.rand(3, generator=self.generator))
        return self.out

    def replay(self):
        done = self.done
        self().add_(self.noise)
        self.done = done


@pytest.fixture
def on_gpu(monkeypatch):
    """A step graph of some work, as on a GPU."""
    generator = torch.Generator()
    work = Work(generator)

    @contextmanager
    def capturing(graph, capture_error_mode):
        graph.again = work.replay
        yield

    class Side:
        def __init__(self, device=None):
            pass

        def wait_stream(self, other):
            pass

    monkeypatch.setattr(torch.cuda, "CUDAGraph", Graph)
    monkeypatch.setattr(torch.cuda, "graph", capturing)
    monkeypatch.setattr(torch.cuda, "Stream", Side)
    monkeypatch.setattr(torch.cuda, "current_stream", Side)
    monkeypatch.setattr(torch.cuda, "stream", lambda stream: torch.no_grad())

    def made(check=True):
        graph = StepGraph(
            torch.device("cuda"), "a test", [generator], (lambda out: out) if check else None, lambda: again(work)
        )
        return graph, work

    return made


def numbers(graph, work, seed, key=0):
    work.generator.manual_seed(seed)
    return graph(key, work).clone()


@pytest.mark.parametrize("check", [True, False])
def test_a_replay_gives_what_the_work_gives(on_gpu, check):
    graph, work = on_gpu(check)
    expected = [torch.rand(3, generator=torch.Generator().manual_seed(seed)) for seed in range(8)]
    for seed in range(8):
        assert torch.equal(numbers(graph, work, seed), expected[seed])
    assert graph.captures == 1
    assert work.done == WARM_UP + 1 + check  # the capture, and what it is compared with


def test_another_key_is_captured_anew_until_it_has_changed_too_often(on_gpu, monkeypatch, capsys):
    graph, work = on_gpu()
    monkeypatch.setattr(step_graph, "MAX_CAPTURES", 2)
    for key in range(3):
        for seed in range(6):
            found = numbers(graph, work, seed, key)
            assert torch.equal(found, torch.rand(3, generator=torch.Generator().manual_seed(seed)))
    assert graph.captures == 2
    assert not graph.works
    assert capsys.readouterr().err == "neurad: a test runs without a CUDA graph: it changed 2 times\n"


@pytest.mark.parametrize("fault", ["capture", "numbers"])
def test_what_cannot_be_captured_or_replays_something_else_is_done_at_each_call(on_gpu, monkeypatch, capsys, fault):
    graph, work = on_gpu()
    if fault == "numbers":
        work.noise = 1.0
    else:
        monkeypatch.setattr(torch.cuda, "graph", lambda *_, **__: refuse())
    for seed in range(8):
        assert torch.equal(numbers(graph, work, seed), torch.rand(3, generator=torch.Generator().manual_seed(seed)))
    assert not graph.works
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert ("a replay gives other numbers" if fault == "numbers" else "operation not permitted") in said


def again(work):
    """Random numbers from the start, by another generator."""
    seed = work.generator.initial_seed()
    work.generator = torch.Generator().manual_seed(seed)


def refuse():
    raise RuntimeError("CUDA error: operation not permitted when stream is capturing\nfor debugging ...")
