"""The suite itself: how much of it enters by the user's door."""

from pathlib import Path

import pytest

TESTS = Path(__file__).resolve().parent
LEAST = 120
"""Tests that go through ``neurad.cli.main`` on real scenes."""


def test_enough_tests_enter_by_the_user_s_door(request):
    """Counted over the whole suite as it was collected; whether each does enter is checked while it runs."""
    collected = {item.path for item in request.session.items}
    if len(collected) < len(list(TESTS.rglob("test_*.py"))) // 2:
        pytest.skip("counts over the whole suite, of which only a part runs")
    entering = [item for item in request.session.items if item.get_closest_marker("main")]
    assert len(entering) >= LEAST
