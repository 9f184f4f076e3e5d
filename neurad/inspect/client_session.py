"""One browser that looks at the room: its camera, its controls, its pictures."""

import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import numpy as np
import torch
import viser
import viser.transforms

from neurad.core.errors import InputError
from neurad.core.records import FloatArray, Rays
from neurad.formats.hints import ONE_MATERIAL, add_hint
from neurad.inspect.panel import Panel, chosen
from neurad.inspect.pose import ACROSS, SPOT, Pose, Stand, Surrounded, Vector
from neurad.inspect.probe import probe
from neurad.inspect.refine import Frame, Refiner, Request, ViewedRun

MAX_ASPECT = 32.0
"""Largest ratio of a window's longer side to its shorter one; pictures of longer windows are stretched."""
QUALITY, QUALITY_COARSE = 95, 80
"""Quality of JPEG pictures, of 100: of fine ones, and of coarse ones while something moves."""
FARTHEST = 1e4
"""Lengths of the page that scrolling away ends at."""
MARK = 0.006
"""Radius of the mark at the point that was read out, over its distance."""


class ClientSession:
    """One browser.

    Callbacks of the page only note what was asked; all pictures are made by :meth:`work`, on one thread.

    Args:
        title: of the run, Markdown.
        exposure: factor of radiance that the photographs ask for.
        stands: places of the views by name; asked for when the camera is to be put there.
        around: what is around the cameras. Positions in the page are in its lengths.
        ask: called whenever something is asked for.
        leave: ends the connection.
        hints: file that hints are written to; None where they are not wanted.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        room: ViewedRun,
        title: str,
        exposure: float,
        stands: Mapping[str, Callable[[], Stand]],
        around: Surrounded,
        ask: Callable[[], None],
        leave: Callable[[], None],
        hints: Path | None = None,
    ) -> None:
        self.leave = leave
        self.began = time.monotonic()
        self.first_picture: float | None = None
        """Seconds from the connection to the first picture."""
        self.frames = 0
        """Pictures sent."""
        self._client, self._stands, self._ask, self._length = client, stands, ask, around.length
        self._refiner = Refiner(room)
        self._waiting: dict[str, Callable[[], None]] = {}  # what was asked for, of each kind the last
        self._failed: Request | None = None
        self._hints = hints
        self._places: list[list[float]] = []  # that were clicked, the last two
        self.panel = Panel(
            client.gui,
            title,
            room,
            tuple(stands),
            around.indoors,
            exposure,
            changed=ask,
            go=lambda name: self._later("view", partial(self._move, name)),
            turn=lambda: self._later("turn", self._pivot),
            hint=(lambda kind: self._later("hint", partial(self._write_hint, kind))) if hints else None,
        )
        client.camera.on_update(lambda _: ask())
        client.scene.on_click()(self._clicked)

    def renew(self, room: ViewedRun, title: str, warning: str) -> None:
        """Look at another state of the run, and say what is wrong with it."""
        if room is not self._refiner.room:
            self._refiner.replace(room)
            self.panel.update(title, room.modes)
        self.panel.warn(warning)

    def work(self, stop: Callable[[], bool]) -> bool:
        """A bounded step; False if there was nothing to do."""
        for kind in [*self._waiting]:
            self._waiting.pop(kind)()
        self._hold()
        request = self._request()
        if request == self._failed or self._refiner.rests(request):
            return False
        try:
            frame = self._refiner.work(request, stop)
        except InputError as error:  # a photograph that is gone, for instance
            self._failed = request
            self.panel.warn(str(error))
            return True
        if frame is not None:
            self._send(frame)
        return True

    def _request(self) -> Request:
        camera = self._client.camera
        x, y, z = (float(v) * self._length for v in camera.position)
        rotation = viser.transforms.SO3(camera.wxyz).as_matrix().ravel()
        aspect = max(camera.image_width, 1) / max(camera.image_height, 1)
        aspect = min(max(aspect, 1.0 / MAX_ASPECT), MAX_ASPECT)
        return self.panel.request(Pose(tuple(float(v) for v in rotation), (x, y, z), float(camera.fov), aspect))

    def _send(self, frame: Frame) -> None:
        quality = QUALITY_COARSE if frame.coarse else QUALITY
        self._client.scene.set_background_image(frame.picture, format="jpeg", jpeg_quality=quality)
        self._client.flush()
        self.frames += 1
        if self.first_picture is None:
            self.first_picture = time.monotonic() - self.began
        height, width = frame.picture.shape[:2]
        self.panel.say(f"{frame.says} {width} x {height} pixels.")

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        origin = np.asarray(event.ray_origin, np.float64) * self._length
        self._later("click", partial(self._read_out, origin, np.asarray(event.ray_direction, np.float64)))

    def _later(self, kind: str, do: Callable[[], None]) -> None:
        """Note what :meth:`work` has to do, in place of what was asked of this kind before."""
        self._waiting[kind] = do
        self._ask()

    def _read_out(self, origin: Vector, direction: Vector) -> None:
        room = self._refiner.room
        reading = probe(room.run, room.seen, origin, direction)
        self.panel.read_out(reading)
        self._places = [*self._places[-1:], reading.written_place()] if reading else []
        if reading is not None:
            place = reading.position.astype(np.float64) / self._length
            away = float(np.linalg.norm(place - np.asarray(origin) / self._length))
            self._client.scene.add_icosphere("/pixel", radius=MARK * away, color=(255, 90, 0), position=place)

    def _write_hint(self, kind: str) -> None:
        """Write what the page says of the points that were clicked last to the file of the command line."""
        places = self._places
        assert self._hints is not None
        if len(places) < (2 if kind == ONE_MATERIAL else 1):
            self.panel.say_hint("Click a point of the picture first; of one material one on each of two surfaces.")
            return
        try:
            count = add_hint(self._hints, {kind: places if kind == ONE_MATERIAL else places[-1]})
        except InputError as error:
            self.panel.say_hint(str(error))
            return
        self.panel.say_hint(f"{count} hint{'s' * (count > 1)}: neurad fit --data.hints {self._hints}")

    def _move(self, name: str) -> None:
        stand, camera = self._stands[chosen(name, self._stands)](), self._client.camera
        with self._client.atomic():
            camera.up_direction = stand.up
            camera.position = stand.position
            camera.look_at = stand.pivot(self._on_the_spot)
            camera.fov = stand.fov_y

    def _pivot(self) -> None:
        """Put what the camera turns around to where it belongs: before its lens, or onto the surface in the middle."""
        camera = self._client.camera
        ahead: Vector = np.asarray(viser.transforms.SO3(camera.wxyz).as_matrix()[:, 2], np.float64)
        away = SPOT if self._on_the_spot else self._distance(camera.position, ahead)
        with self._client.atomic():
            camera.max_orbit_distance = FARTHEST
            camera.look_at = np.asarray(camera.position, np.float64) + away * ahead

    def _hold(self) -> None:
        """Let nothing scroll away a camera that turns on the spot, once it is there: the bound would pull it."""
        camera = self._client.camera
        if self._on_the_spot and float(np.linalg.norm(camera.look_at - camera.position)) < 2.0 * SPOT:
            camera.max_orbit_distance = SPOT

    @property
    def _on_the_spot(self) -> bool:
        return bool(self.panel.on_the_spot.value)

    def _distance(self, position: FloatArray | Vector, ahead: Vector) -> float:
        """Lengths of the page to the surface that is ahead; as far as across the room where there is none."""
        world = self._refiner.room.run.world
        ray = np.stack((position * self._length, ahead)).astype(np.float32)
        o, d = torch.tensor(ray, device=world.two_sided.device).unsqueeze(1)
        hit = world.tracer.closest(Rays(o, d))
        return max(float(hit.t), SPOT) / self._length if bool(hit.valid) else ACROSS
