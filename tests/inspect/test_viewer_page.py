"""``neurad view`` as a person has it: the page in Chromium, its pictures, sliders and read-out."""

import re
import shutil
import socket
import time
from io import BytesIO

import numpy as np
import pytest
from helpers.listening import listening
from helpers.tiny_fit import fails
from helpers.viewed import viewed
from PIL import Image
from trimesh.triangles import closest_point

import neurad
from neurad.checkpoints.file import write_checkpoint
from neurad.formats.hints import hint_entries, hints_of

pytest.importorskip("viser")
from neurad.inspect.viewer import Followed

CANVAS = {"x": 40, "y": 140, "width": 360, "height": 290}
"""Part of the window that neither controls cover nor what is said of missing graphics hardware."""


class Page:
    """The open page: its picture and its controls."""

    def __init__(self, seen):
        self.seen, self.page = seen, seen.page

    def text(self):
        return self.page.inner_text("body")

    def wait(self, words, seconds=30):
        self.page.wait_for_function(
            "words => document.body.innerText.includes(words)", arg=words, timeout=1000 * seconds
        )

    def picture(self):
        """What is shown, beside the controls [h, w, 3]."""
        return np.asarray(Image.open(BytesIO(self.page.screenshot(clip=CANVAS))).convert("RGB")).astype(float)

    def settled(self):
        """The picture once it stays nearly the same."""
        before, end = self.picture(), time.monotonic() + 30
        while time.monotonic() < end:
            time.sleep(0.15)
            now = self.picture()
            change = np.abs(now - before).mean()
            if now.std() > 0.3 and change < 2.0:
                return now
            before = now
        raise AssertionError(f"the picture never came to rest: spread {now.std():.2f}, change {change:.2f}")

    def choose(self, label, option):
        self.page.get_by_label(label, exact=True).click()
        self.page.get_by_role("option", name=option, exact=True).click()

    def slide(self, label, value):
        """Write a number into the field beside a slider."""
        slider = self.page.locator(f"label:text-is('{label}')").get_attribute("for")
        field = self.page.locator(f"[id='{slider}'] + div input")
        field.fill(str(value))
        field.press("Enter")


def place(session):
    """Where a browser's camera is, and the unit direction that it looks in."""
    pose = session._request().pose
    return np.array(pose.position), np.reshape(pose.rotation, (3, 3))[:, 2]


def test_the_page(viewed_run, look_at, tmp_path):
    hints = tmp_path / "hints.yaml"
    hints.write_text("# by hand\n- leave_out: [0, 0, 0]\n")
    with viewed("--ckpt_path", str(viewed_run), "--port", "0", "--hints", str(hints)) as viewer:
        port = int(viewer.address.split(":")[2].partition("/")[0])
        assert listening(port=port) == ["0100007F"]  # 127.0.0.1
        page = Page(look_at(viewer.address, width=800, height=480))
        page.wait("pixels.")
        page.choose("size", "128")
        lit = page.settled()
        assert lit.std() > 5
        (session,) = viewer.sessions.values()
        assert session.first_picture < 5
        assert "iteration 60" in page.text()

        # modes have pictures of their own; test_viewer_pictures.py has all of them
        shown = [lit]
        for mode, words in {
            "albedo": "The recovered albedo.",
            "albedo error bars": "How sure the recovered albedo is",
        }.items():
            page.choose("mode", mode)
            page.wait(words)
            shown.append(page.settled())
        for i, a in enumerate(shown):
            assert all(np.abs(a - b).mean() > 2 for b in shown[:i])

        # photographs at the left, the render at the right
        page.choose("mode", "render")
        page.slide("photograph | render", 1)
        page.wait("laid onto the surfaces")
        photographed = page.settled()
        assert all(np.abs(photographed - other).mean() > 2 for other in shown)
        page.slide("photograph | render", 0.25)
        page.wait("Left: The photographs")
        parted = page.settled()
        parting = round(0.25 * 800) - CANVAS["x"]
        assert np.abs(parted - photographed)[:, : parting - 10].mean() < 2
        assert np.abs(parted - lit)[:, parting + 10 :].mean() < np.abs(parted - photographed)[:, parting + 10 :].mean()
        page.slide("photograph | render", 0)

        # a lamp that is switched off makes the room darker, and comes back
        page.wait("photographs' light")
        page.slide(viewer._room.lamps[0].name, 0)
        page.wait("Paths traced for each lamp")
        assert page.settled().mean() < 0.9 * lit.mean()
        page.page.get_by_role("button", name="as photographed").click()
        page.wait("photographs' light")
        back = page.settled()
        assert back.mean() == pytest.approx(lit.mean(), rel=0.12)  # it goes on from the field to the method

        # a point is read out
        page.page.mouse.click(240, 260)
        page.wait("albedo: ")
        said = page.text()
        assert re.search(r"albedo: 0\.\d{3} 0\.\d{3} 0\.\d{3}( ± 0\.\d{3} 0\.\d{3} 0\.\d{3})?", said)
        assert re.search(r"roughness: [01]\.\d{3}", said)
        assert "metallic: 0 (no surface here" in said
        assert re.search(r"photographs: \d+: train_\d+", said)
        assert "mesh:" not in said  # folded away
        page.page.get_by_text("pixel", exact=True).click()
        page.wait("mesh: ")
        said = page.text()
        assert any(f"mesh: {mesh.name}" in said for mesh in viewer._followed.run.scene.meshes)

        # three buttons write down what is said of it
        page.page.get_by_role("button", name="this is one material").click()
        page.wait("on each of two surfaces")
        page.page.get_by_role("button", name="this shines").click()
        page.wait("2 hints: neurad fit --data.hints")
        page.page.mouse.click(150, 330)
        page.wait("albedo: ")
        time.sleep(0.5)
        page.page.get_by_role("button", name="this is one material").click()
        page.wait("3 hints")
        page.page.get_by_role("button", name="leave this out").click()
        page.wait("4 hints")
        assert hints.read_text().startswith("# by hand\n- leave_out: [0, 0, 0]\n- shines: [")
        said_of = hints_of(hint_entries(str(hints)))
        shines, (one, other) = said_of.shines[0].place, (told.place for told in said_of.one_material[0])
        assert one == shines
        assert said_of.leave_out[1].place == other != one
        geometry = viewer._followed.run.world.geometry
        corners = geometry.vertices[geometry.faces].double().numpy()
        for p in (one, other):
            on = closest_point(corners, np.broadcast_to(p, (len(corners), 3)))
            assert np.linalg.norm(on - p, axis=1).min() < 1e-3 * geometry.scale

        # the first view is a photograph's, and dragging turns on the spot
        first = viewer._followed.run.scene.train[0].camera.to_world
        position, ahead = place(session)
        assert np.allclose(position, first[:3, 3], atol=1e-3)
        assert np.allclose(ahead, -first[:3, 2], atol=1e-3)
        page.page.mouse.move(240, 240)
        page.page.mouse.down()
        page.page.mouse.move(360, 270, steps=4)
        page.page.mouse.up()
        time.sleep(0.5)
        assert np.abs(page.settled() - back).mean() > 4
        turned, there = place(session)
        across = 10 * viewer._around.length
        assert np.allclose(turned, position, atol=0.01 * across)
        assert float(there @ ahead) < 0.95
        page.page.mouse.wheel(0, -300)  # nothing is walked through
        page.page.keyboard.down("w")
        time.sleep(0.5)
        page.page.keyboard.up("w")
        time.sleep(0.5)
        walked, towards = place(session)[0] - turned, place(session)[1]
        assert float(towards @ there) > 0.98
        assert float(walked @ there) > 0.02 * across
        assert abs(walked[1]) < 0.02 * np.linalg.norm(walked)  # one walks, and does not fly
        assert abs(walked[0] * there[2] - walked[2] * there[0]) < 0.2 * np.linalg.norm(walked)
        page.page.get_by_label("turn on the spot").click(force=True)  # from now on around what is in the middle
        page.wait("Drag to turn around")
        here = place(session)[0]
        page.page.mouse.move(240, 240)
        page.page.mouse.down()
        page.page.mouse.move(300, 240, steps=4)
        page.page.mouse.up()
        time.sleep(0.5)
        assert np.linalg.norm(place(session)[0] - here) > 0.02 * across

        assert page.seen.errors == []
        asked = [
            address for address in page.seen.network if not re.match(rf"(http|ws)://127\.0\.0\.1:{port}/", address)
        ]
        assert asked == []


def test_a_run_that_trains_on_and_then_is_gone(viewed_run, tmp_path, look_at, monkeypatch):
    """A newer checkpoint is taken over under the open page; when the folder is deleted the page says so and stays."""
    from neurad.inspect import viewer as module

    monkeypatch.setattr(module, "CHECKS", 0.1)
    place = shutil.copytree(viewed_run, tmp_path / "`<b id=evil>`")  # Markdown on the page
    with viewed("--ckpt_path", str(place), "--port", "0") as viewer:
        page = Page(look_at(viewer.address, width=800, height=480))
        page.wait("pixels.")
        import torch

        content = torch.load(place / "checkpoints/last.ckpt", weights_only=True)
        content["neurad"]["iteration"] = 61
        write_checkpoint(content, place / "checkpoints/last.ckpt")
        page.wait("iteration 61")
        shutil.rmtree(place)
        page.wait("is gone")
        assert page.text().count("<b id=evil>") == 2  # in the title and in the warning
        assert page.page.locator("#evil").count() == 0
        assert page.settled().std() > 2
        (session,) = viewer.sessions.values()
        frames = session.frames
        page.choose("mode", "albedo")
        page.wait("The recovered albedo.")
        assert session.frames > frames


def test_a_newer_checkpoint_changes_what_is_recovered(viewed_run, tmp_path):
    import torch

    place = shutil.copytree(viewed_run, tmp_path / "version_0")
    followed = Followed(neurad.load(place))
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    before = followed.run.map("albedo", points)
    assert not followed.update()
    path = place / "checkpoints/last.ckpt"
    content = torch.load(path, weights_only=True)
    for name, value in content["state_dict"].items():
        if name.startswith(("materials.albedo", "average.mean")) and value.is_floating_point():
            content["state_dict"][name] = value + 0.3
    content["neurad"]["iteration"] += 40
    write_checkpoint(content, path)
    assert followed.update()
    assert followed.run.iteration == 100
    assert np.abs(followed.run.map("albedo", points) - before).mean() > 0.01
    assert followed.run.bars is None  # those of the folder are of iteration 60
    assert not followed.update()

    kept = followed.run.map("albedo", points)
    path.write_bytes(b"no checkpoint")
    assert not followed.update()
    assert "last.ckpt" in followed.problem
    path.unlink()
    assert not followed.update()
    assert "is gone" in followed.problem
    assert np.array_equal(followed.run.map("albedo", points), kept)


def test_hints_that_cannot_be_added_to(capfd, tmp_path):
    """Found before the run is read, which is not there."""
    (tmp_path / "hints.yaml").write_text("- shines: [0, 0]\n")
    for file, words in (("hints.yaml", "entry 1: shines is"), (".", "it is a folder"), ("no/hints.yaml", "no")):
        error = fails(capfd, "view", "--ckpt_path", "nowhere", "--port", "0", "--hints", str(tmp_path / file))
        assert words in error


def test_a_port_in_use(capfd):
    """Found before the run is read, which is not there."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        error = fails(capfd, "view", "--ckpt_path", "nowhere", "--port", str(port))
    assert f"--port {port}: it is in use" in error


def test_the_extra_is_missing(capfd, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "viser", None)
    assert "pip install 'neurad[view]'" in fails(capfd, "view")
