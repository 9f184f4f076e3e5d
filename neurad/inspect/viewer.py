"""The viewer: a page on this machine alone, and the one loop that makes its pictures."""

import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import viser

from neurad.checkpoints.find import LAST, run_folder_of
from neurad.core.errors import InputError
from neurad.core.scene_records import View
from neurad.formats.axes import up_axis
from neurad.inspect.client_session import ClientSession
from neurad.inspect.lamps import lamps_of
from neurad.inspect.maps import PhotographMap, SeenMap, modes_of
from neurad.inspect.panel import plain
from neurad.inspect.pose import Stand, stand_of, surrounded
from neurad.inspect.refine import ViewedRun, warm_up
from neurad.inspect.server import connection_closer, say_dropped, serve, stop
from neurad.metrics.seen import SeenBy
from neurad.runs.load import LoadedRun, reload_run
from neurad.runtime.threads import torch_on_one
from neurad.scene.exposure import scene_exposure

CHECKS = 2.0
"""Seconds between two looks at the run folder."""


class Followed:
    """A run that may still be training and its last checkpoint; a run of another checkpoint stays as it is."""

    def __init__(self, run: LoadedRun) -> None:
        folder = run_folder_of(run.checkpoint)
        assert folder is not None
        self.run = run
        """As it is now."""
        self.folder = folder
        self.problem = ""
        """Why a newer checkpoint was not taken over, in a sentence; empty where all is well."""
        self._path = folder / LAST
        self._follows = run.checkpoint.resolve() == self._path
        self._stamp = _stamp(self._path)

    def update(self) -> bool:
        """Take over a newer checkpoint, into the same parts; True if there was one, and :attr:`run` is another object.

        Without the file, or with one that cannot be used, everything stays as it is and :attr:`problem` says why.
        """
        stamp = _stamp(self._path)
        if not self._follows or (stamp == self._stamp and stamp is not None):
            return False
        if stamp is None:
            what = "the run folder" if not self.folder.exists() else LAST.name
            self.problem = f"{what} is gone ({self.folder}): this is the last state, of iteration {self.run.iteration}"
            return False
        self._stamp = stamp
        try:
            self.run = reload_run(self.run)
        except InputError as error:
            self.problem = str(error)
            return False
        self.problem = ""
        return True


def _stamp(path: Path) -> tuple[int, int] | None:
    """What changes with a file; None where there is none."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_ino


class Viewer:
    """A run in the browser.

    Args:
        port: of the page, 0 for any; None takes the first free from 8080.
        hints: file that hints of the page are written to; None offers none.

    Attributes:
        address: what to open in a browser; who does not know it is not let in.

    Raises:
        InputError: the port is taken, or the scene has no view to begin with.
    """

    def __init__(self, run: LoadedRun, port: int | None = None, hints: Path | None = None) -> None:
        views = sorted((*run.scene.train, *run.scene.test), key=lambda view: view.image is None)
        if not views:
            raise InputError(f"scene {run.scene.name}: it has no view to begin with; a fit's scene has some")
        self._followed, self._hints = Followed(run), hints
        self._views: dict[str, View] = {view.name: view for view in views}
        self._exposure = scene_exposure(run.scene)
        self._by_training = SeenBy.of(run.world.geometry, run.world.tracer, run.scene.train)
        self._photographs = PhotographMap(run.world, run.views)
        self._around = surrounded(run.world, [view.camera for view in views])
        self._room = self._make_room()
        self._asked = 0
        self._wake = threading.Event()
        self._checked = time.monotonic()
        self.sessions: dict[int, ClientSession] = {}
        """Browsers that are connected, by number."""
        with torch_on_one():
            warm_up(self._room, views[0].camera)
        self._server, self.address = serve(port)
        self._arrange(self._stand(views[0]))

    def run(self, until: Callable[[], bool] = lambda: False) -> None:
        """Make pictures until ``until()`` is true, which is looked at a few times a second."""
        with torch_on_one():  # parts of a picture are one thread's each; torch's own would wait by spinning
            while not until():
                self.step()

    def step(self) -> None:
        """One bounded piece of work, or a short sleep where there is none."""
        if time.monotonic() - self._checked > CHECKS:
            self._follow()
        asked = self._asked
        worked = [self._served(n, lambda session: session.work(lambda: self._asked != asked)) for n in [*self.sessions]]
        if not any(worked):
            self._wake.wait(0.25)
            self._wake.clear()

    def _served(self, number: int, work: Callable[[ClientSession], bool | None]) -> bool:
        """Do something for one browser, and whether there was something to do. What fails for it ends it alone."""
        session = self.sessions.get(number)
        if session is None:
            return False
        try:
            return bool(work(session))
        except Exception as error:
            say_dropped(error)
            self.sessions.pop(number, None)
            session.leave()
            return True

    def close(self) -> None:
        """End the page."""
        stop(self._server)

    def _make_room(self) -> ViewedRun:
        run = self._followed.run
        seen = SeenMap(run.world, self._by_training)
        return ViewedRun(run, lamps_of(run.assembly), modes_of(run, seen, self._photographs), seen)

    def _title(self) -> str:
        run = self._followed.run
        return f"`{plain(self._followed.folder.name)}` of `{plain(run.scene.name)}`, iteration {run.iteration}"

    def _stand(self, view: View) -> Stand:
        return stand_of(view.camera, self._followed.run.world, self._around.length)

    def _arrange(self, first: Stand) -> None:
        """Put the camera to the first view, and welcome browsers."""
        server, up = self._server, up_axis(self._followed.run.scene)
        server.scene.set_up_direction(up if up in ("-x", "-y", "-z") else f"+{up}")  # type: ignore[arg-type]
        server.initial_camera.position = first.position
        server.initial_camera.look_at = first.pivot(self._around.indoors)
        server.initial_camera.up = first.up
        server.initial_camera.fov = first.fov_y
        server.gui.configure_theme(show_logo=False, show_share_button=False)
        server.on_client_connect(self._welcome)
        server.on_client_disconnect(self._part)

    def _part(self, client: viser.ClientHandle) -> None:
        self.sessions.pop(client.client_id, None)

    async def _welcome(self, client: viser.ClientHandle) -> None:
        stands = {name: partial(self._stand, view) for name, view in self._views.items()}
        session = ClientSession(
            client,
            self._room,
            self._title(),
            self._exposure,
            stands,
            self._around,
            self._ask,
            connection_closer(),
            self._hints,
        )
        self.sessions[client.client_id] = session
        self._ask()

    def _ask(self) -> None:
        """Somebody waits for something."""
        self._asked += 1
        self._wake.set()

    def _follow(self) -> None:
        """Take over a newer checkpoint of a run that is still training, and error bars that came with its end."""
        followed = self._followed
        if followed.update() or (followed.run.bars is not None) != self._room.has_bars:
            cost = self._room.cost
            self._room = self._make_room()
            self._room.cost.update(cost)
        for number in [*self.sessions]:
            self._served(number, lambda session: session.renew(self._room, self._title(), followed.problem))
        self._checked = time.monotonic()
