"""The suite itself: what enters by the user's door, and that test files stand on their own."""

import ast
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


@pytest.mark.parametrize("path", sorted(TESTS.rglob("*.py")), ids=lambda path: str(path.relative_to(TESTS)))
def test_no_test_file_imports_another(path):
    tree = ast.parse(path.read_text())
    imported = [node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    imported += [alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names]
    assert not [name for name in imported if any(part.startswith("test_") for part in name.split("."))]
