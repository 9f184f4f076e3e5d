"""The README and the pages of ``docs/``."""

import re
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
DOCS = REPOSITORY / "docs"
PAGES = [REPOSITORY / "README.md", REPOSITORY / "CHANGELOG.md", *sorted(DOCS.glob("*.md"))]

pages = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
"""A test of each."""


def without_blocks(text):
    """The page without fenced and indented code."""
    text = re.sub(r"^```.*?^```", "", text, flags=re.S | re.M)
    return re.sub(r"^ {4}(?! *[-*\d]).*$", "", text, flags=re.M)
