"""A first start has a second process compile kernels: those that a fit will ask for, and only where none are there."""

import os
import time

from helpers.tiny_fit import few_views, fit, write_tiny_config

from neurad.runs import compile_ahead


def test_a_fit_asks_for_the_kernels_that_are_compiled_ahead(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    few_views(monkeypatch, "kitchen", 2)
    write_tiny_config(base="kitchen.yaml")
    fit("--trainer.max_steps=1", "--trainer.logger=false")
    for kernel, given in compile_ahead.kernels():
        assert compile_ahead.types(kernel, given) in kernel.signatures, kernel


def test_the_process_fills_an_empty_cache_and_is_started_for_no_other(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(compile_ahead, "usable_cores", lambda: 2)
    compile_ahead.start()
    process = compile_ahead._process
    try:
        until = time.monotonic() + 60.0
        while not list(tmp_path.glob("fields_*/mlp_kernels.forward-*.nbi")):  # the first
            assert process.poll() is None
            assert time.monotonic() < until
            time.sleep(0.05)
    finally:
        process.kill()
        process.wait()

    started = []
    monkeypatch.setattr(compile_ahead.subprocess, "Popen", lambda *_, **__: started.append(None))
    index = tmp_path / "fields_0" / "hash_grid_kernels.is_ascending-1.py311.nbi"
    index.parent.mkdir(exist_ok=True)
    index.touch()
    compile_ahead.start()
    assert not started
    os.utime(index, (0, 0))  # older than its source
    compile_ahead.start()
    assert started
