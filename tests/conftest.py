"""What all tests share: one thread, one seed, and no silent skip of optional backends in CI."""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import pytest
import torch

OPTIONAL = ("mitsuba", "open3d")


@pytest.fixture(autouse=True)
def _seeded():
    torch.manual_seed(0)


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item, call):
    """In CI a test that skips because an optional backend is missing fails."""
    outcome = yield
    report = outcome.get_result()
    if os.environ.get("NEURAD_CI") and report.skipped and any(name in str(report.longrepr) for name in OPTIONAL):
        report.outcome = "failed"
        report.longrepr = f"optional backend missing in CI: {report.longrepr}"
