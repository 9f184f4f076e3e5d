"""What a browser asks for, and the pictures that it gets: coarse ones while something moves, better ones after."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from neurad.core.records import Bytes
from neurad.core.scene_records import Camera
from neurad.inspect.lamps import Lamp, as_photographed
from neurad.inspect.maps import BARS, PHOTOGRAPH, RENDER, Mode, SeenMap
from neurad.inspect.pose import Pose, pose_of
from neurad.inspect.still import LitStill, Look, MapStill, SplitStill, Still
from neurad.runs.load import LoadedRun

SETTLED = 0.25
"""Seconds without a movement after which the camera rests."""
FRAME = 0.08
"""Seconds that a picture may take while the camera moves: it gets as few pixels as that needs."""
PATIENCE = 0.3
"""Seconds that the first picture after a change may take; else a coarse one comes before it."""
BETWEEN = 0.1
"""Seconds from one picture to the next that is only better."""
COARSEST = 48 * 48
"""Fewest pixels of such a picture."""


@dataclass(frozen=True)
class ViewedRun:
    """A run as it can be looked at."""

    run: LoadedRun
    lamps: Sequence[Lamp]
    modes: Mapping[str, Mode]
    seen: SeenMap
    cost: dict[str, float] = field(default_factory=dict)
    """Seconds a pixel that first pictures took, by kind; grows as pictures are made."""

    @property
    def has_bars(self) -> bool:
        """Whether there are modes for error bars."""
        return any(name.endswith(BARS) for name in self.modes)


@dataclass(frozen=True)
class Request:
    """What a browser wants to see."""

    pose: Pose
    mode: str
    look: Look
    pixels: int
    """Number of pixels of a picture at rest."""


@dataclass(frozen=True)
class Frame:
    """A picture to be sent."""

    picture: Bytes
    says: str
    coarse: bool
    """It has fewer pixels than asked for."""


class Refiner:
    """Makes pictures for one browser, one bounded step at a time."""

    def __init__(self, room: ViewedRun) -> None:
        self.room = room
        self._still: Still | None = None
        self._key: tuple[Pose, str, bool, int] | None = None
        self._look: Look | None = None
        self._moved = self._sent = -math.inf

    def replace(self, room: ViewedRun) -> None:
        """Begin anew with another room, such as the same run with newer weights."""
        self.room = room
        self._still = self._key = None

    def rests(self, request: Request) -> bool:
        """Whether there is nothing to do for a request."""
        same = self._key == _key(request) and self._look == request.look
        return same and self._still is not None and self._still.done(request.look)

    def work(self, request: Request, stop: Callable[[], bool]) -> Frame | None:
        """A step towards a picture, or less if ``stop()`` says that somebody waits; None where none is to show yet."""
        key, look = _key(request), request.look
        if self._still is None or self._key != key:
            moves = self._key is not None and self._key[0] != request.pose
            if moves:
                self._moved = time.monotonic()
            self._key, self._look, self._still = key, look, self._new(request, request.pixels, moves=False)
            if moves or self._seconds(request) > PATIENCE:
                return self.coarse(request)
        elif self._look != look:
            self._look = look
            return self._frame(request) if self._still.ready(look) else self.coarse(request)
        if time.monotonic() - self._moved < SETTLED and not self._still.ready(look):
            time.sleep(0.01)
            return None
        if not self._still.step(look, stop) or not self._still.ready(look):
            return None
        soon = time.monotonic() - self._sent < BETWEEN and not self._still.done(look)
        return None if soon else self._frame(request)

    def _frame(self, request: Request) -> Frame:
        assert self._still is not None
        self._sent = time.monotonic()
        return Frame(self._still.picture(request.look), self._still.says(request.look), False)

    def coarse(self, request: Request) -> Frame:
        """A quick picture of as many pixels as a moment allows."""
        pixels = int(min(max(request.pixels * FRAME / self._seconds(request), COARSEST), request.pixels))
        still = self._new(request, pixels, moves=True)
        start = time.monotonic()
        while not still.ready(request.look):
            still.step(request.look, lambda: False)
        picture = still.picture(request.look)
        taken = (time.monotonic() - start) / (picture.shape[0] * picture.shape[1])
        cost = self.room.cost
        cost[_kind(request)] = 0.5 * (cost.get(_kind(request), taken) + taken)
        return Frame(picture, still.says(request.look), pixels < request.pixels)

    def _seconds(self, request: Request) -> float:
        """What the first picture at rest will take; a careful guess where nothing was measured."""
        return self.room.cost.get(_kind(request), FRAME / COARSEST) * request.pixels

    def _new(self, request: Request, pixels: int, moves: bool) -> Still:
        room = self.room
        camera: Camera = replace(request.pose.camera(pixels), flash=room.run.scene.flash)

        def shown(mode: str) -> MapStill:
            return MapStill(camera, room.modes[mode], room.seen.unseen, room.run.device, moves)

        is_lit = request.mode == RENDER or request.mode not in room.modes
        still = LitStill(room.run, camera, room.lamps) if is_lit else shown(request.mode)
        return SplitStill(shown(PHOTOGRAPH), still) if _is_split(request) and PHOTOGRAPH in room.modes else still


def _is_split(request: Request) -> bool:
    return request.look.photographs > 0.0


def _key(request: Request) -> tuple[Pose, str, bool, int]:
    return request.pose, request.mode, _is_split(request), request.pixels


def _kind(request: Request) -> str:
    """What the time of a first picture depends on."""
    light = request.look.light
    own = light.turn == 0.0 and all(scale == 1.0 for scale in light.scales)
    return f"{request.mode}{'' if own else ' edited'}{' split' if _is_split(request) else ''}"


def warm_up(room: ViewedRun, camera: Camera) -> None:
    """Make a small picture of every kind, so that nobody who looks waits for kernels to be loaded, or compiled.

    Afterwards ``room.cost`` knows how long pictures take.
    """
    own = as_photographed(room.lamps)
    dim = replace(own, scales=(0.5, *own.scales[1:]))
    pose = pose_of(camera)
    refiner = Refiner(room)
    for _ in range(2):  # what is loaded in the first turn may not count
        room.cost.clear()
        for mode in (RENDER, *room.modes):
            refiner.coarse(Request(pose, mode, Look(own), 4 * COARSEST))
        for look in (Look(dim), Look(own, photographs=0.5)):
            refiner.coarse(Request(pose, RENDER, look, 4 * COARSEST))
