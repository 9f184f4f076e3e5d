"""What all tests share: one thread, one seed, and no silent skip of optional backends in CI."""

import gc
import os
import shutil
import sys

os.environ.setdefault("OMP_WAIT_POLICY", "passive")
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # processes that tests start, and the next run, need not compile again
if "PYTEST_XDIST_WORKER" in os.environ:  # each worker has a core to itself
    os.environ.setdefault("OMP_NUM_THREADS", "1")

from functools import cache
from pathlib import Path

import pytest
import torch
import yaml
from browser import chromium, look_at  # noqa: F401  fixtures of every test
from helpers.one_parser import share_parsers

from neurad.runtime.lean_imports import import_lightning

gc.disable()  # until all tests are imported: a sixth of the time that takes
sys.dont_write_bytecode = False
import_lightning()  # as neurad does, before a test imports all of it
share_parsers()

OPTIONAL = ("mitsuba", "open3d", "warp", "mkdocs", "xatlas", "pxr", "Node", "Chromium", "playwright", "rawpy", "cv2")


def pytest_collection_finish():
    """Collect garbage of tests, seldom, and leave alone what was imported."""
    gc.freeze()
    gc.set_threshold(10_000)  # of usual 700: a twenty-fifth of a test's time
    gc.enable()


@pytest.fixture(autouse=True)
def _seeded():
    torch.manual_seed(0)


@pytest.fixture
def three_threads():
    """As many chunks of large work, however few cores there are."""
    from helpers.torch_threads import torch_threads

    with torch_threads(3):
        yield


@pytest.fixture
def warp_on_cpu(monkeypatch):
    """Warp's kernels for tensors on the CPU as well, where Warp runs them on one thread, instead of numba's."""
    pytest.importorskip("warp")
    from neurad.runtime import dispatch

    monkeypatch.setattr(dispatch, "WARP_DEVICES", ("cpu", "cuda"))


@pytest.fixture
def mi():
    """Mitsuba with the variant ``scalar_rgb``; afterwards the one that was set before, if any was."""
    mitsuba = pytest.importorskip("mitsuba")
    before = mitsuba.variant()
    mitsuba.set_variant("scalar_rgb")
    yield mitsuba
    if before:
        mitsuba.set_variant(before)


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A working folder whose name has a space and an umlaut."""
    folder = tmp_path / "Zimmer für alle"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return folder


@pytest.fixture
def tiny(tmp_path, monkeypatch):
    """The test's own folder as the working one, with ``tiny.yaml`` in it (see helpers/tiny_fit.py), and few views of
    the Cornell box: too few for error bars, so that a fit takes half a second and not a whole one.
    """
    from helpers.tiny_fit import few_views, write_tiny_config

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("neurad.callbacks.evaluation.PICTURES", 0)
    few_views(monkeypatch, "cornell", 3)
    write_tiny_config()
    return tmp_path


@pytest.fixture(scope="session")
def finished(tmp_path_factory):
    """Gives a folder with a finished run of two iterations, of the base that is named; each is made once."""
    from helpers.tiny_fit import finished_run

    return cache(lambda base: finished_run(tmp_path_factory.mktemp("finished") / "Räume und mehr", base))


@pytest.fixture
def fitted_box(finished, tmp_path, monkeypatch):
    """A copy of a run of few views of the Cornell box and its ``tiny.yaml``, as the working folder."""
    from helpers.tiny_fit import few_views

    few_views(monkeypatch, "cornell", 3)
    return _copied(finished("cornell.yaml"), tmp_path, monkeypatch)


@pytest.fixture
def fitted_room(finished, tmp_path, monkeypatch):
    """A copy of a run, its ``tiny.yaml`` and the scene folder ``room`` that it is of, as the working folder."""
    pytest.importorskip("mitsuba")
    return _copied(finished("scene.yaml"), tmp_path, monkeypatch)


def _copied(folder, tmp_path, monkeypatch):
    shutil.copytree(folder, tmp_path / folder.name)
    monkeypatch.chdir(tmp_path / folder.name)
    return tmp_path / folder.name


@pytest.fixture(scope="session")
def small_rooms(tmp_path_factory):
    """Gives a small Cornell box with photographs and true albedo; each is made once."""
    from helpers.small_fit import photographed_cornell

    return cache(lambda glossy, unit: photographed_cornell(tmp_path_factory.mktemp("small"), glossy, unit))


@pytest.fixture
def small(tmp_path, monkeypatch, small_rooms):
    """Registers a small Cornell box with photographs and true albedo as the built-in scene 'small'."""
    from helpers.small_fit import SMALL_FIT

    from neurad.scene import builtin

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("neurad.callbacks.evaluation.PICTURES", 0)

    def make(glossy, unit=1.0):
        scene = small_rooms(glossy, unit)
        monkeypatch.setitem(builtin._BUILDERS, "small", lambda: scene)
        Path("fit.yaml").write_text(yaml.safe_dump(SMALL_FIT))

    return make


def _forbid_skip(report):
    """In CI a report that skips because an optional backend is missing becomes a failure."""
    if not os.environ.get("NEURAD_CI") or not report.skipped:
        return
    reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
    if any(name in reason for name in OPTIONAL):
        report.outcome = "failed"
        report.longrepr = f"optional backend missing in CI: {reason}"


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item, call):
    """Skips in tests and fixtures."""
    outcome = yield
    _forbid_skip(outcome.get_result())


@pytest.hookimpl(hookwrapper=True)
def pytest_make_collect_report(collector):
    """Skips of whole modules, by an importorskip at their top."""
    outcome = yield
    _forbid_skip(outcome.get_result())
