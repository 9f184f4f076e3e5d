"""A picture from one place that gets better with every step: the lit room, or a map of it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
import torch
from torch import Tensor

from neurad.core.protocols import Integrator
from neurad.core.records import Bytes, FloatArray
from neurad.core.rng import mix
from neurad.core.scene_records import Camera
from neurad.inspect.film import MIN_SAMPLES, Film, Smoother, common, mixture
from neurad.inspect.lamps import Lamp, LightSettings, as_photographed, lamp_renderer
from neurad.inspect.maps import Mode, hatch
from neurad.integrators.renderer import FieldRenderer, MethodRenderer
from neurad.pages.colours import encode
from neurad.runs.load import LoadedRun

Stop = Callable[[], bool]
FIELD_SPP, MAP_SPP, MAX_SPP = 16, 16, 1024
"""Samples a pixel after which the radiance field's picture, a map and a sampled picture are good enough."""
SEED = 20231123


@dataclass(frozen=True)
class Look:
    """How a picture is to be shown; changing it costs no new samples where light is linear in it."""

    light: LightSettings
    exposure: float = 1.0
    """Factor of radiance."""
    hatched: bool = True
    """Mark what no photograph shows."""
    photographs: float = 0.0
    """How much of the picture, from its left edge, shows the photographs instead."""


class MapStill:
    """A map without noise: its samples are for the edges. It has the methods of :class:`LitStill`.

    Args:
        unseen: marks what no photograph shows; None where the mode does that itself, or nothing is known of it.
        device: where it is computed.
        moves: it is for a moment only, and little time.
    """

    def __init__(
        self,
        camera: Camera,
        mode: Mode,
        unseen: Integrator | None,
        device: torch.device | str = "cpu",
        moves: bool = False,
    ) -> None:
        self.mode = mode
        self._film = Film(camera, (mode.quick if moves else None) or mode.integrator, SEED, device)
        self._unseen = None if unseen is None or not mode.hatches else Film(camera, unseen, SEED, device)

    def step(self, look: Look, stop: Stop) -> bool:
        """Another sample in every pixel."""
        if look.hatched and self._unseen is not None and self._unseen.count == 0 and self._film.count > 0:
            return self._unseen.add(stop)
        return self._film.add(stop)

    def ready(self, look: Look) -> bool:
        """After the first sample."""
        return self._film.count > 0

    def done(self, look: Look) -> bool:
        """After enough samples for smooth edges."""
        return self._film.count >= MAP_SPP

    def picture(self, look: Look) -> Bytes:
        """The map in its colours, hatched if that is wanted."""
        picture = self.mode.show(self._film.mean.cpu().numpy(), look.exposure)
        if look.hatched and self._unseen is not None and self._unseen.count > 0:
            picture = hatch(picture, self._unseen.mean.cpu().numpy())
        return picture

    def says(self, look: Look) -> str:
        """What the map is."""
        return self.mode.says


class LitStill:
    """The room in any light of its lamps.

    In the light of the photographs it begins as the radiance field's own picture, which has no noise, and goes over to
    the method's, sample by sample. In other light it is the sum of path-traced pictures of each lamp, smoothed at first
    (:class:`neurad.inspect.film.Smoother`), which begin in a mixture with the picture in the photographs' light
    (:func:`neurad.inspect.film.mixture`).
    """

    def __init__(self, run: LoadedRun, camera: Camera, lamps: Sequence[Lamp]) -> None:
        self.run, self.camera, self.lamps = run, camera, lamps
        estimator = run.assembly.estimator
        self._own = as_photographed(lamps)
        self._field = None if run.radiance is None else Film(camera, FieldRenderer(estimator), SEED, run.device)
        self._whole = Film(camera, MethodRenderer(estimator.method, estimator), mix(SEED, 1), run.device)
        self._turn = 0.0
        self._weight = 1.0
        self._films = [self._film(index) for index in range(len(lamps))]
        self._smoother: Smoother | None = None
        self._made: dict[Film, tuple[int, Tensor]] = {}

    def _film(self, index: int) -> Film:
        """A film of the light of one lamp alone."""
        renderer = cache(partial(lamp_renderer, self.run.assembly, self.lamps[index], self._turn))  # few are needed
        return Film(self.camera, lambda rays, seed: renderer()(rays, seed), mix(SEED, 2, index), self.run.device)

    def step(self, look: Look, stop: Stop) -> bool:
        """Another sample in every pixel, of what makes the picture better most."""
        return self._next(look.light).add(stop)

    def ready(self, look: Look) -> bool:
        """Whether every picture that it takes has a sample."""
        films, prior = self._parts(look.light)
        return (not prior or self._begun) and all(self._films[i].count > 0 for i in films)

    def done(self, look: Look) -> bool:
        """After :data:`MAX_SPP` samples."""
        light = look.light
        if light == self._own:
            return self._whole.count >= MAX_SPP
        return all(self._films[i].count >= MAX_SPP for i in self._shining(light))

    def picture(self, look: Look) -> Bytes:
        """The picture so far as a screen shows it."""
        return encode(self.radiance(look.light) * np.float32(look.exposure))

    def radiance(self, light: LightSettings) -> FloatArray:
        """The picture so far in a light, linear [h, w, 3]; it has to be ready for it."""
        needed, prior = self._parts(light)
        base = self._photographed() if prior else None
        if light == self._own and base is not None:
            return np.asarray(base.cpu().numpy(), np.float32)
        chosen = range(len(self.lamps)) if prior else needed
        if not chosen:  # every lamp is off
            return np.zeros((self.camera.height, self.camera.width, 3), np.float32)
        films, scales = [self._films[i] for i in chosen], [light.scales[i] for i in chosen]
        shown = [self._smoothed(film) for film in films if film.count > 0]
        mixed, self._weight = mixture(base, films, scales, shown)
        return np.asarray(mixed.cpu().numpy(), np.float32)

    def says(self, look: Look) -> str:
        """What the picture is."""
        light = look.light
        if light == self._own:
            if self._field is not None and self._whole.count < MIN_SAMPLES:
                return "The radiance field's own picture, in the photographs' light."
            begun = "" if self._field is None else ", begun with the radiance field's"
            return f"The method's picture in the photographs' light, {self._whole.count} samples a pixel{begun}."
        if not self._shining(light):
            return "Every lamp is off."
        counts = [film.count for film, scale in zip(self._films, light.scales, strict=True) if film.count or scale]
        if max(counts) == 0:
            return "The picture in the photographs' light, scaled."
        samples = f"{min(counts)}" if min(counts) == max(counts) else f"{min(counts)} to {max(counts)}"
        return f"Paths traced for each lamp with the recovered materials, {samples} samples a pixel, smoothed if few."

    def _shining(self, light: LightSettings) -> list[int]:
        """Lamps that are not off."""
        return [i for i, scale in enumerate(light.scales) if scale > 0.0]

    def _parts(self, light: LightSettings) -> tuple[list[int], bool]:
        """Lamps whose own pictures a light needs at least, and whether that in the photographs' light is needed.

        With it, all lamps that are as bright as most are in it already. It is no help once the environment is turned.
        """
        shining = self._shining(light)
        self._follow(light)
        if self._turn != 0.0:
            return shining, False
        usual = common(light.scales)
        others = [i for i, scale in enumerate(light.scales) if scale != usual]
        return others, usual != 0.0

    def _follow(self, light: LightSettings) -> None:
        """Begin anew with the environment's picture where it was turned."""
        lit = [i for i in self._shining(light) if self.lamps[i].is_environment]
        if lit and light.turn % 360.0 != self._turn:
            self._turn = light.turn % 360.0
            self._made.pop(self._films[lit[0]], None)
            self._films[lit[0]] = self._film(lit[0])

    @property
    def _begun(self) -> bool:
        """Whether there is a picture in the photographs' light."""
        return (self._whole if self._field is None else self._field).count > 0

    def _photographed(self) -> Tensor:
        """The picture so far in the photographs' light [h, w, 3]."""
        if self._field is None:
            return self._smoothed(self._whole)
        return mixture(self._field.mean, [self._whole], [1.0])[0] if self._whole.count else self._field.mean

    def _smoothed(self, film: Film) -> Tensor:
        """The picture of a film, mixed with what smoothing makes of it as long as that is better [h, w, 3]."""
        count, picture = self._made.get(film, (0, None))
        if picture is None or count != film.count:
            if self._smoother is None:
                self._smoother = Smoother(self.run.assembly, self.camera)
            picture = mixture(self._smoother(film.mean), [film], [1.0])[0]
            self._made[film] = film.count, picture
        return picture

    def _next(self, light: LightSettings) -> Film:
        """The film that gets a sample."""
        films, prior = self._parts(light)
        field, whole = self._field, self._whole
        if light == self._own:
            return whole if field is None or field.count > min(whole.count, FIELD_SPP - 1) else field
        if prior and not self._begun:
            return whole if field is None else field
        if missing := [i for i in films if self._films[i].count == 0]:
            return self._films[missing[0]]
        if prior and field is not None and field.count < FIELD_SPP // 4:
            return field
        used = list(range(len(self.lamps))) if prior else self._shining(light)
        if few := [i for i in used if self._films[i].count < MIN_SAMPLES]:
            return self._films[few[0]]
        # By how much a sample lowers the error. A lamp that the photographs' light brings in gets some all the same, as
        # only its own picture shows what is wrong with that.
        weight = self._weight if prior else 0.0
        share = [max(abs(light.scales[i] - weight), 0.3 * light.scales[i]) for i in used]
        gain = [
            part**2 * float(self._films[i].variance.mean()) / (self._films[i].count + 1)
            for part, i in zip(share, used, strict=True)
        ]
        return self._films[used[int(np.argmax(gain))]]


class SplitStill:
    """Photographs at the left and another picture of the camera at the right, as ``Look.photographs`` parts them."""

    def __init__(self, photographs: MapStill, other: LitStill | MapStill) -> None:
        self._left, self._right = photographs, other

    def _shown(self, look: Look) -> list[MapStill | LitStill]:
        return [self._left, self._right] if look.photographs < 1.0 else [self._left]

    def step(self, look: Look, stop: Stop) -> bool:
        """Another sample in every pixel of the half that has none yet, or else of one that is not done."""
        stills = self._shown(look)
        left = [s for s in stills if not s.ready(look)] or [s for s in stills if not s.done(look)]
        return left[0].step(look, stop)

    def ready(self, look: Look) -> bool:
        """Whether both halves can be shown."""
        return all(still.ready(look) for still in self._shown(look))

    def done(self, look: Look) -> bool:
        """Whether both halves are good enough."""
        return all(still.done(look) for still in self._shown(look))

    def picture(self, look: Look) -> Bytes:
        """The picture so far, with a line between its halves."""
        picture = self._left.picture(look)
        if look.photographs < 1.0:
            column = round(look.photographs * picture.shape[1])
            picture = np.concatenate((picture[:, :column], self._right.picture(look)[:, column:]), 1)
            picture[:, column - 1 : column] = 255
        return picture

    def says(self, look: Look) -> str:
        """What the halves are."""
        if look.photographs >= 1.0:
            return self._left.says(look)
        return f"Left: {self._left.says(look)} Right: {self._right.says(look)}"


Still = LitStill | MapStill | SplitStill
"""A picture that is refined."""
