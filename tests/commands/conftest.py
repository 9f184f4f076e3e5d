"""The working folder of tests of commands."""

import pytest


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A working folder whose name has a space and an umlaut."""
    folder = tmp_path / "Zimmer für alle"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return folder
