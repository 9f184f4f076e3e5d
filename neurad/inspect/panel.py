"""The controls beside the picture, one panel a browser."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser

from neurad.core.errors import InputError
from neurad.core.ranges import Range
from neurad.inspect.lamps import Lamp, LightSettings
from neurad.inspect.maps import RENDER, Mode, legend
from neurad.inspect.probe import Reading
from neurad.inspect.still import Look

SIDES = ("128", "256", "512", "1024")
"""Pictures have as many pixels as a square of one of these sides."""
BRIGHTEST = 4.0
"""Largest factor of a lamp."""
_HINT = "Click a point of the picture to read it out."


@dataclass(frozen=True)
class Wishes:
    """What the controls say."""

    mode: str
    look: Look
    side: int


class Panel:
    """Controls and texts of one browser.

    Args:
        gui: of that browser.
        title: of the run.
        lamps: of the scene.
        modes: names of the modes beyond the lit one, with what they show.
        views: names of the views that the camera can be put to.
        exposure: factor of radiance that the photographs ask for.
        changed: called after every change of a control.
        go: called with the name of a view that the camera is to be put to.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        title: str,
        lamps: Sequence[Lamp],
        modes: Mapping[str, Mode],
        views: Sequence[str],
        exposure: float,
        changed: Callable[[], None],
        go: Callable[[str], None],
    ) -> None:
        self._gui, self._lamps, self._modes, self._exposure = gui, lamps, modes, exposure
        self._title = gui.add_markdown(title)
        self._mode: Any = gui.add_dropdown("mode", (RENDER, *modes), initial_value=RENDER)
        self._legend = gui.add_image(np.zeros((1, 1, 3), np.uint8), format="png", visible=False)
        self._says = gui.add_markdown("")
        self._warning = gui.add_markdown("")
        with gui.add_folder("pixel"):
            self._reading = gui.add_markdown(_HINT)
        with gui.add_folder("light"):
            self._sliders: list[Any] = [gui.add_slider(lamp.name, 0.0, BRIGHTEST, 0.05, 1.0) for lamp in lamps]
            self._turn: Any = None
            if any(lamp.is_environment for lamp in lamps):
                self._turn = gui.add_slider(
                    "turn", 0, 360, 1, 0, hint="Degrees that the environment is turned, counterclockwise from above."
                )
            self._reset = gui.add_button("as photographed")
        with gui.add_folder("picture"):
            self._view = gui.add_dropdown("view", tuple(views) or ("none",))
            self._stops = gui.add_slider("exposure", -6.0, 6.0, 0.25, 0.0, hint="In stops: 1 is twice as bright.")
            self._side = gui.add_dropdown(
                "size", SIDES, initial_value="256", hint="As many pixels as a square of that side has."
            )
            self._hatched = gui.add_checkbox("hatch what no photograph shows", True)
        for control in (self._stops, self._side, self._hatched, *self._sliders, *([self._turn] if self._turn else [])):
            control.on_update(lambda _: changed())
        self._view.on_update(lambda _: go(self._view.value))

        @self._mode.on_update
        def _(_: object) -> None:
            self._show_legend()
            changed()

        @self._reset.on_click
        def _(_: object) -> None:
            for slider in self._sliders:
                slider.value = 1.0
            if self._turn:
                self._turn.value = 0
            changed()

    def wishes(self) -> Wishes:
        """What the controls say now.

        Raises:
            InputError: something that no control of the page can say.
        """
        light = LightSettings(tuple(_level(s) for s in self._sliders), _level(self._turn) if self._turn else 0.0)
        look = Look(light, self._exposure * 2.0 ** _level(self._stops), bool(self._hatched.value))
        return Wishes(chosen(self._mode.value, self._mode.options), look, int(chosen(self._side.value, SIDES)))

    def say(self, text: str) -> None:
        """Say what the picture is."""
        if self._says.content != text:
            self._says.content = text

    def warn(self, text: str) -> None:
        """Say what is wrong; nothing is with an empty text."""
        shown = f"⚠ {_escaped(text)}" if text else ""
        if self._warning.content != shown:
            self._warning.content = shown

    def read_out(self, reading: Reading | None) -> None:
        """Show what is under the pointer."""
        if reading is None:
            self._reading.content = "There is no surface."
            return
        self._reading.content = "\n".join(f"- {name}: `{plain(value)}`" for name, value in reading.lines())

    def update(self, title: str, modes: Mapping[str, Mode]) -> None:
        """Other modes, or a run that went on."""
        self._title.content = title
        names = (RENDER, *modes)
        if tuple(self._mode.options) != names:
            kept = self._mode.value if self._mode.value in names else RENDER
            self._mode.options = names
            self._mode.value = kept
        self._modes = modes

    def _show_legend(self) -> None:
        mode = self._modes.get(self._mode.value)
        scale = None if mode is None else mode.scale
        self._legend.visible = scale is not None
        if scale is not None:
            self._legend.image = legend(scale)
            self._legend.label = f"{scale.title}: 0 to {scale.high:g}"


def _escaped(text: str) -> str:
    """Text that Markdown shows unchanged."""
    return re.sub(r"([!-/:-@\[-`{-~])", r"\\\1", " ".join(text.split()))


def chosen(value: object, options: Iterable[str]) -> str:
    """The option that a control says.

    Raises:
        InputError: there is no such option.
    """
    for option in options:
        if option == value:
            return option
    raise InputError("a choice that the page does not have")


def _level(slider: Any) -> float:
    """What a slider says, within its range: the field beside it sends what is typed before the page looks at it.

    Raises:
        InputError: NaN.
    """
    value = float(slider.value)
    if value not in Range():
        raise InputError(f"the slider {slider.label} at {value}")
    return min(max(value, float(slider.min)), float(slider.max))


def plain(text: str) -> str:
    """Text that Markdown shows unchanged between backticks."""
    return " ".join(text.replace("`", "'").split())
