"""The controls beside the picture, one panel a browser."""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import viser

from neurad.core.errors import InputError
from neurad.core.ranges import Range
from neurad.formats.hints import LEAVE_OUT, ONE_MATERIAL, SHINES
from neurad.inspect.lamps import LightSettings
from neurad.inspect.maps import PHOTOGRAPH, RENDER, Mode, legend
from neurad.inspect.pose import Pose
from neurad.inspect.probe import Reading
from neurad.inspect.refine import Request, ViewedRun
from neurad.inspect.still import Look

SIDES = ("128", "256", "512", "1024")
"""Pictures have as many pixels as a square of one of these sides."""
BRIGHTEST = 4.0
"""Largest factor of a lamp."""
_WALK = "Drag to turn, **W A S D** to walk, **Q E** to go down and up; click a point to read it out."
_ORBIT = "Drag to turn around what is in the middle, scroll to go nearer; click a point to read it out."
_HINTS = {
    SHINES: ("this shines", "The patch around the point is a lamp of unknown radiance."),
    ONE_MATERIAL: ("this is one material", "The surfaces at the last two points that were clicked are."),
    LEAVE_OUT: ("leave this out", "What shows the surface at the point neither trains nor scores."),
}
"""Buttons of hints and what they say, by kind."""


class Panel:
    """Controls and texts of one browser.

    Args:
        views: names of the views that the camera can be put to, the first of which it shows.
        exposure: factor of radiance that the photographs ask for.
        changed: called after every change of what is to be seen.
        go: called with the name of a view that the camera is to be put to.
        turn: called when the camera is to turn on the spot from now on, or around something.
        hint: called with the kind of a hint about what was clicked last; None where none are taken.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        title: str,
        room: ViewedRun,
        views: Sequence[str],
        indoors: bool,
        exposure: float,
        changed: Callable[[], None],
        go: Callable[[str], None],
        turn: Callable[[], None],
        hint: Callable[[str], None] | None,
    ) -> None:
        self._modes, self._exposure = room.modes, exposure
        self._title = gui.add_markdown(title)
        self._help = gui.add_markdown(_WALK if indoors else _ORBIT)
        self._view = gui.add_dropdown("view", tuple(views) or ("none",))
        self._mode: Any = gui.add_dropdown("mode", _names(room.modes), initial_value=RENDER)
        self._share: Any = None
        if PHOTOGRAPH in room.modes:
            self._share = gui.add_slider(
                "photograph | render", 0.0, 1.0, 0.01, 0.0,
                hint="How much of the picture, from the left, is the photographs', laid onto the surfaces.",
            )  # fmt: skip
        self._legend = gui.add_image(np.zeros((1, 1, 3), np.uint8), format="png", visible=False)
        self._says = gui.add_markdown("")
        self._warning = gui.add_markdown("")
        self._reading = gui.add_markdown("")
        self._hinted: Any = None
        if hint is not None:
            for kind, (label, says) in _HINTS.items():
                gui.add_button(label, hint=says).on_click(partial(_called, hint, kind))
            self._hinted = gui.add_markdown("")
        with gui.add_folder("pixel", expand_by_default=False):
            self._place = gui.add_markdown("Nothing was clicked.")
        with gui.add_folder("light"):
            self._sliders: list[Any] = [gui.add_slider(lamp.name, 0.0, BRIGHTEST, 0.05, 1.0) for lamp in room.lamps]
            self._turn: Any = None
            if any(lamp.is_environment for lamp in room.lamps):
                self._turn = gui.add_slider(
                    "turn", 0, 360, 1, 0, hint="Degrees that the environment is turned, counterclockwise from above."
                )
            self._reset = gui.add_button("as photographed")
        with gui.add_folder("picture"):
            self.on_the_spot: Any = gui.add_checkbox(
                "turn on the spot", indoors, hint="As one does indoors; else drag to turn around what is in the middle."
            )
            self._stops = gui.add_slider("exposure", -6.0, 6.0, 0.25, 0.0, hint="In stops: 1 is twice as bright.")
            self._side = gui.add_dropdown(
                "size", SIDES, initial_value="512", hint="As many pixels as a square of that side has."
            )
            self._hatched = gui.add_checkbox("hatch what no photograph shows", True)
        more = [control for control in (self._turn, self._share) if control]
        for control in (self._stops, self._side, self._hatched, *self._sliders, *more):
            control.on_update(lambda _: changed())
        self._view.on_update(lambda _: go(self._view.value))

        @self.on_the_spot.on_update
        def _(_: object) -> None:
            self._help.content = _WALK if self.on_the_spot.value else _ORBIT
            turn()

        @self._mode.on_update
        def _(_: object) -> None:
            mode = self._modes.get(self._mode.value)
            scale = None if mode is None else mode.scale
            self._legend.visible = scale is not None
            if scale is not None:
                self._legend.image = legend(scale)
                self._legend.label = f"{scale.title}: 0 to {scale.high:g}"
            changed()

        @self._reset.on_click
        def _(_: object) -> None:
            for slider in self._sliders:
                slider.value = 1.0
            if self._turn:
                self._turn.value = 0
            changed()

    def request(self, pose: Pose) -> Request:
        """What the controls ask for now, seen from a place.

        Raises:
            InputError: something that no control of the page can say.
        """
        light = LightSettings(tuple(_level(s) for s in self._sliders), _level(self._turn) if self._turn else 0.0)
        share = _level(self._share) if self._share else 0.0
        look = Look(light, self._exposure * 2.0 ** _level(self._stops), bool(self._hatched.value), share)
        mode, side = chosen(self._mode.value, self._mode.options), int(chosen(self._side.value, SIDES))
        return Request(pose, mode, look, side**2)

    def say(self, text: str) -> None:
        """Say what the picture is."""
        if self._says.content != text:
            self._says.content = text

    def warn(self, text: str) -> None:
        """Say what is wrong; nothing is with an empty text."""
        shown = f"⚠ {_escaped(text)}" if text else ""
        if self._warning.content != shown:
            self._warning.content = shown

    def say_hint(self, text: str) -> None:
        """Say what became of a hint."""
        self._hinted.content = _escaped(text)

    def read_out(self, reading: Reading | None) -> None:
        """Show what is under the pointer."""
        lines = reading.lines() if reading else []
        self._reading.content = _items(lines) if lines else "There is no surface."
        self._place.content = _items(reading.place_lines()) if reading else "There is no surface."

    def update(self, title: str, modes: Mapping[str, Mode]) -> None:
        """Other modes, or a run that went on."""
        self._title.content = title
        names = _names(modes)
        if tuple(self._mode.options) != names:
            kept = self._mode.value if self._mode.value in names else RENDER
            self._mode.options = names
            self._mode.value = kept
        self._modes = modes


def _called(hint: Callable[[str], None], kind: str, _: object) -> None:
    hint(kind)


def _names(modes: Mapping[str, Mode]) -> tuple[str, ...]:
    """What can be chosen: photographs have a slider of their own."""
    return (RENDER, *(name for name in modes if name != PHOTOGRAPH))


def _items(lines: Iterable[tuple[str, str]]) -> str:
    return "\n".join(f"- {name}: `{plain(value)}`" for name, value in lines)


def _escaped(text: str) -> str:
    """Text that Markdown shows unchanged."""
    return re.sub(r"([!-/:-@\[-`{-~])", r"\\\1", " ".join(text.split()))


def chosen(value: object, options: Iterable[str]) -> str:
    """The option that a control says."""
    for option in options:
        if option == value:
            return option
    raise InputError("a choice that the page does not have")


def _level(slider: Any) -> float:
    """What a slider says, within its range: the field beside it sends what is typed before the page looks at it."""
    value = float(slider.value)
    if value not in Range():
        raise InputError(f"the slider {slider.label} at {value}")
    return min(max(value, float(slider.min)), float(slider.max))


def plain(text: str) -> str:
    """Text that Markdown shows unchanged between backticks."""
    return " ".join(text.replace("`", "'").split())
