"""Debian's Chromium without a window, driven by playwright: what the pages that neurad makes look like and do.

``from browser import Seen`` for types; the fixtures ``chromium`` and ``look_at`` are everybody's (``conftest.py``).
"""

import shutil
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
FLAGS = (
    "--no-sandbox",  # tests run as root in containers
    "--enable-unsafe-swiftshader",  # WebGL without a GPU
    "--force-color-profile=srgb",
)
LAPTOP = (1366, 768)
"""Width and height of a window on a common laptop."""
LOCAL = ("file:", "data:", "blob:", "about:")
"""Beginnings of addresses that need no network."""
SECONDS = 30
"""That anything on a page may take on a busy machine."""


@dataclass
class Seen:
    """A page with what it complained of and asked for while it was open."""

    page: Any
    """Playwright's, see https://playwright.dev/python/docs/api/class-page."""
    errors: list[str] = field(default_factory=list)
    """Of the console, uncaught exceptions, and requests that failed."""
    requests: list[str] = field(default_factory=list)
    """Addresses asked for, data URIs left out."""

    @property
    def network(self) -> list[str]:
        """Addresses that are not on this machine's disk."""
        return [address for address in self.requests if not address.startswith(LOCAL)]

    def picture(self, path: Path, full_page: bool = False) -> Path:
        """A screenshot as PNG."""
        path.parent.mkdir(parents=True, exist_ok=True)
        self.page.screenshot(path=path, full_page=full_page)
        return path

    def width(self) -> tuple[int, int]:
        """Widths of what is on the page and of the window: a page that needs no sideways scrolling has them equal."""
        found = self.page.evaluate("[document.documentElement.scrollWidth, document.documentElement.clientWidth]")
        return int(found[0]), int(found[1])


def executable():
    """The path of an installed Chromium; skips without one."""
    found = next(filter(None, map(shutil.which, NAMES)), None)
    if found is None:
        pytest.skip("Chromium is missing, which shows the pages (apt-get install chromium)")
    return found


@pytest.fixture(scope="module")
def chromium():
    """A running Chromium for the tests of a module; skips where it or playwright is missing.

    Not for the whole session: playwright keeps an event loop in this thread, in which ``asyncio.run`` would fail.
    """
    api = pytest.importorskip("playwright.sync_api", reason="playwright is missing, which drives Chromium")
    path = executable()
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=[*FLAGS], timeout=1000 * SECONDS)
        yield browser
        browser.close()


@pytest.fixture
def look_at(chromium):
    """Opens pages: ``look_at(address or file, width=..., height=..., dark=..., offline=...)`` gives :class:`Seen`."""
    contexts = []

    def look(target, width=LAPTOP[0], height=LAPTOP[1], dark=False, offline=False):
        context = chromium.new_context(
            viewport={"width": width, "height": height}, color_scheme="dark" if dark else "light"
        )
        contexts.append(context)
        context.set_default_timeout(1000 * SECONDS)
        context.set_offline(offline)
        seen = Seen(context.new_page())
        seen.page.on("console", lambda said: seen.errors.append(said.text) if said.type == "error" else None)
        seen.page.on("pageerror", lambda error: seen.errors.append(str(error)))
        seen.page.on("requestfailed", lambda asked: seen.errors.append(f"{asked.url[:200]}: {asked.failure}"))
        seen.page.on(
            "request", lambda asked: None if asked.url.startswith("data:") else seen.requests.append(asked.url)
        )
        seen.page.goto(target.resolve().as_uri() if isinstance(target, Path) else target)
        return seen

    yield look
    for context in contexts:
        with suppress(Exception):  # a server that is gone may not hide what the test says
            context.close()
