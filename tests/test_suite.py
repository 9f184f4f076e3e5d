"""The suite itself: how much of it enters by the user's door."""

import re
from pathlib import Path

LEAST = 120
DOORS = r"\b(main|fit|fails|stops|fit_small|printed_config)\("
"""Calls of ``neurad.cli.main`` and of helpers that call it."""


def test_enough_tests_enter_by_the_user_s_door():
    """Functions that go through ``neurad.cli.main``, by their text."""
    files = [path.read_text() for path in Path(__file__).parent.rglob("test_*.py")]
    tests = [test for text in files if "neurad.cli" in text or "tiny_fit" in text for test in text.split("\ndef test_")]
    assert sum(bool(re.search(DOORS, test)) for test in tests) >= LEAST
