"""Takes the screenshots of the docs with an installed Chromium, from a finished run of the demo.

    pip install -e '.[view,docs,test]'
    neurad fit --config kitchen.yaml && neurad test
    neurad compare --config kitchen.yaml --methods ours,no_prior,prb --budget 40 --seeds 0,1
    python docs/screens.py lightning_logs/version_0 --report report

It opens the run's ``report.html``, the page of the comparison, ``neurad view``, TensorBoard and this site. Names
after the run take only these:
``python docs/screens.py RUN view_albedo site``.
"""

from __future__ import annotations

import argparse
import re
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path

from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

DOCS = Path(__file__).resolve().parent
FLAGS = ("--no-sandbox", "--enable-unsafe-swiftshader", "--force-color-profile=srgb")
SECONDS = 180
"""That anything may take on a busy machine."""
RESTS = 15.0
"""Seconds that the viewer gets to make a picture better."""
WIDE, ROOM, SMALL = (1200, 760), (1000, 640), (600, 384)
STEPS = 14
"""Places of the slider in the film."""


def save(page: Page, name: str, out: Path) -> None:
    """A screenshot."""
    keep(Image.open(BytesIO(page.screenshot())).convert("RGB"), name, out)


def keep(picture: Image.Image, name: str, out: Path) -> None:
    """Write a picture small: those full of pictures as JPEG, those of words and lines with few colours as PNG."""
    out.mkdir(parents=True, exist_ok=True)
    file = out / f"{name}.{'jpg' if name in PICTURES else 'png'}"
    if name in PICTURES:
        picture.save(file, quality=70, optimize=True)
    else:
        picture.quantize(256, dither=Image.Dither.NONE).save(file, optimize=True)
    print(f"{file.name}: {file.stat().st_size / 1000:.0f} kB", flush=True)


@contextmanager
def opened(browser: Browser, address: str, size: tuple[int, int], dark: bool = False) -> Iterator[Page]:
    """A page in a window of that size."""
    scheme = "dark" if dark else "light"
    page = browser.new_page(viewport={"width": size[0], "height": size[1]}, color_scheme=scheme)
    page.set_default_timeout(1000 * SECONDS)
    page.goto(address)
    yield page
    page.close()


@contextmanager
def served(words: list[str], ready: str) -> Iterator[str]:
    """A program that serves a page until the block ends; gives the address that it says in a line with ``ready``."""
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        assert process.stdout is not None
        for line in process.stdout:
            if ready in line and (found := re.search(r"http://\S+", line)):
                yield found[0]
                return
        raise SystemExit(f"{' '.join(words)} ended without an address")
    finally:
        process.terminate()
        process.wait(30)


def report(browser: Browser, run: Path, out: Path, wanted: set[str]) -> None:
    """The top of the report, one of its views in dark colours, and how it ends."""
    address = (run / "report.html").resolve().as_uri()
    if "report" in wanted:
        with opened(browser, address, (1366, 900)) as page:
            save(page, "report", out)
    for name, heading, dark in (("report_view", "Views", True), ("report_end", "How to read this", False)):
        if name in wanted:
            with opened(browser, address, WIDE, dark) as page:
                page.locator(f"h2:text-is('{heading}')").evaluate("element => element.scrollIntoView()")
                time.sleep(0.5)
                save(page, name, out)


def comparison(browser: Browser, folder: Path, out: Path, wanted: set[str]) -> None:
    """The top of a comparison's page, and its figures."""
    if "compare" in wanted:
        with opened(browser, (folder / "index.html").resolve().as_uri(), (1366, 900)) as page:
            save(page, "compare", out)
    for name in ("curves_psnr", "crops"):
        if name in wanted:
            picture = Image.open(folder / f"{name}.png").convert("RGB")
            keep(picture.resize((1200, 1200 * picture.height // picture.width), Image.Resampling.LANCZOS), name, out)


def choose(page: Page, label: str, option: str) -> None:
    """Choose from a list of the viewer's."""
    page.get_by_label(label, exact=True).click()
    page.get_by_role("option", name=option, exact=True).click()
    page.mouse.move(330, 400)  # pictures have buttons below the mouse


def viewer(browser: Browser, run: Path, out: Path, wanted: set[str]) -> None:
    """The room in the viewer's modes, and with its biggest lamp off."""
    modes = {"view_albedo": "albedo", "view_roughness": "roughness"}
    modes |= {"view_bars": "albedo error bars", "view_seen": "seen"}
    if not wanted & {"view_render", "view_photograph", "view_lamps", "lamps", *modes}:
        return
    words = [sys.executable, "-m", "neurad", "view", "--ckpt_path", str(run), "--port", "0"]
    with served(words, "open ") as address, opened(browser, address, ROOM) as page:
        page.wait_for_function("() => document.body.innerText.includes('samples a pixel')")
        for button in page.locator(".mantine-Notification-closeButton").all():
            button.click()  # viser's word on missing graphics hardware
        page.mouse.click(330, 400)
        if "view_render" in wanted:
            time.sleep(RESTS)
            save(page, "view_render", out)
        if "view_photograph" in wanted:
            slide(page, "photograph | render", 0.5)
            time.sleep(RESTS)
            save(page, "view_photograph", out)
            slide(page, "photograph | render", 0)
        for name, mode in modes.items():
            if name in wanted:
                choose(page, "mode", mode)
                time.sleep(RESTS)
                save(page, name, out)
        if wanted & {"view_lamps", "lamps"}:
            choose(page, "mode", "render")
            for label, value in {"skylight": 0, "sky": 0, "garden": 0, "lamps": 4, "exposure": 0.5}.items():
                slide(page, label, value)
            time.sleep(4 * RESTS)
        if "view_lamps" in wanted:
            save(page, "view_lamps", out)
        if "lamps" in wanted:
            slide(page, "skylight", 0.15)
            time.sleep(2 * RESTS)
            film(page, out / "lamps.gif")


def slide(page: Page, label: str, value: float) -> None:
    """Set a slider of the viewer's by the field beside it."""
    slider = page.locator(f"label:text-is('{label}')").get_attribute("for")
    field = page.locator(f"[id='{slider}'] + div input")
    field.fill(str(value))
    field.press("Enter")


def film(page: Page, file: Path) -> None:
    """Six seconds of the viewer's slider of the lamps, up and down again."""
    frames = []
    for step in range(STEPS):
        slide(page, "lamps", round(4.0 * step / (STEPS - 1), 2))
        time.sleep(2.0)
        picture = Image.open(BytesIO(page.screenshot())).convert("RGB").resize(SMALL, Image.Resampling.LANCZOS)
        frames.append(picture.quantize(96, kmeans=4, dither=Image.Dither.NONE))
    frames += frames[-2:0:-1]
    each = round(6000 / len(frames))
    frames[0].save(file, save_all=True, append_images=frames[1:], duration=each, loop=0, optimize=True)
    print(f"{file.name}: {file.stat().st_size / 1000:.0f} kB", flush=True)


def tensorboard(browser: Browser, run: Path, out: Path, wanted: set[str]) -> None:
    """TensorBoard's charts and its sheets."""
    if "tensorboard" not in wanted:
        return
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    words = [sys.executable, "-m", "tensorboard.main", "--logdir", str(run), "--host", "127.0.0.1", "--port", str(port)]
    with served(words, "TensorBoard") as address, opened(browser, f"{address}?smoothing=0#timeseries", WIDE) as page:
        page.wait_for_function("() => document.body.innerText.includes('albedo_psnr')")
        page.get_by_label("Ignore outliers in chart scaling").uncheck()
        page.get_by_role("button", name="Settings").first.click()  # puts them away
        time.sleep(RESTS)
        save(page, "tensorboard", out)


def site(browser: Browser, run: Path, out: Path, wanted: set[str]) -> None:
    """The first page of this site."""
    if "site" not in wanted:
        return
    with tempfile.TemporaryDirectory() as folder:
        mkdocs = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--config-file", str(DOCS.parent / "mkdocs.yml")]
        subprocess.run([*mkdocs, "--site-dir", folder], check=True)
        with opened(browser, (Path(folder) / "index.html").as_uri(), WIDE) as page:
            save(page, "site", out)


NAMES = (
    "report", "report_view", "report_end", "view_render", "view_photograph", "view_albedo", "view_roughness",
    "view_bars", "view_seen", "view_lamps", "tensorboard", "site", "compare", "curves_psnr", "crops", "lamps",
)  # fmt: skip
PICTURES = {"report_view", "report_end", "site", "crops", *(name for name in NAMES if name.startswith("view_"))}


def main(args: list[str] | None = None) -> None:
    """Take them."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("run", type=Path, help="run folder")
    parser.add_argument("names", nargs="*", help=f"only these of {', '.join(NAMES)}")
    parser.add_argument("--report", type=Path, default=Path("report"), help="folder of a comparison (default: report)")
    parser.add_argument("--out", type=Path, default=DOCS / "screens", help="folder")
    options = parser.parse_args(args)
    wanted = set(options.names or NAMES)
    if unknown := sorted(wanted - set(NAMES)):
        parser.error(f"unknown: {', '.join(unknown)}")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=[*FLAGS])
        for shots in (report, viewer, tensorboard, site):
            shots(browser, options.run, options.out, wanted)
        comparison(browser, options.report, options.out, wanted)
        browser.close()


if __name__ == "__main__":
    main()
