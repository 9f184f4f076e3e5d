"""A finished or running fit as Python objects, without a Trainer: :func:`neurad.load`."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from omegaconf import OmegaConf
from torch import Tensor

from neurad.assembly.build import Assembly, assemble
from neurad.assembly.fitted_materials import FittedMaterials
from neurad.assembly.left_out import without_surfaces
from neurad.assembly.lighting import lit_scene
from neurad.assembly.model_settings import ModelSettings
from neurad.assembly.relight import in_other_light
from neurad.checkpoints.file import read_checkpoint
from neurad.checkpoints.find import named_checkpoint, newest_checkpoint, run_folder_of
from neurad.checkpoints.state import changed_light, fitted_lamps, fitting
from neurad.core.camera import camera_rays
from neurad.core.errors import InputError
from neurad.core.parameters import METALLIC
from neurad.core.records import FloatArray, SurfaceInteraction
from neurad.core.scene_records import Camera, View
from neurad.evidence.bar_maps import bars_at
from neurad.evidence.bars_file import NAME, read_bars
from neurad.evidence.error_bars import ErrorBars
from neurad.fields.radiance import RadianceField
from neurad.formats.cameras import HOLD_OUT
from neurad.formats.load import load_scene
from neurad.formats.reader import Reader
from neurad.images.development import Photography
from neurad.integrators.film import render
from neurad.integrators.renderer import MethodRenderer
from neurad.integrators.world import World
from neurad.metrics.seen import SeenBy
from neurad.runs.model_settings import parse_model, parse_reader
from neurad.runs.own_config import own_config
from neurad.runs.trust import import_trusted
from neurad.runtime.reading import expanded
from neurad.scene.description import Scene
from neurad.scene.origin import camera_in_scene, in_scene
from neurad.scene.shining import shining_from_state
from neurad.scene.textures import TrueMaterials
from neurad.training.prepared_scene import with_poses

CHUNK = 1 << 17
"""Points that go through the fields at once, to bound the memory."""

Points = npt.ArrayLike | SurfaceInteraction
"""Positions [n, 3] in the coordinates of the scene's files, or surface points of :meth:`LoadedRun.surface`."""


@dataclass(frozen=True, repr=False)
class LoadedRun:
    """The result of a fit. Materials are the averaged ones if the run averages, as in ``neurad test``.

    Attributes:
        checkpoint: the file that was read.
        iteration: iterations that the fit had done.
        assembly: scene, settings, world, materials and radiance field.
        device: where these lie.
    """

    checkpoint: Path
    iteration: int
    assembly: Assembly
    device: torch.device
    light_changes: tuple[str, ...] = ()
    """What differs between the scene's light and that of the fit, a few words each."""

    def __repr__(self) -> str:
        """The run in a line: everything else that it has is long."""
        scene = f"{self.scene.name} of {len(self.scene.train)} training and {len(self.scene.test)} held-out views"
        return f"LoadedRun({str(self.checkpoint)!r}, iteration {self.iteration}, {scene}, {self.device})"

    @property
    def scene(self) -> Scene:
        """Geometry, lights, true materials and cameras (``scene.train``, ``scene.test``).

        Of a room far from the origin of its files' coordinates, and only there, ``scene.origin`` is subtracted from
        all of these, and from the points of :meth:`surface`.
        """
        return self.assembly.scene

    @property
    def views(self) -> tuple[View, ...]:
        """Training views, then held-out ones: ``name``, ``camera`` and ``image``, the path of the photograph."""
        return (*self.scene.train, *self.scene.test)

    @property
    def settings(self) -> ModelSettings:
        """All settings under ``model``."""
        return self.assembly.settings

    @property
    def world(self) -> World:
        """The scene for light transport: traced geometry, lights and BSDF."""
        return self.assembly.world

    @property
    def materials(self) -> FittedMaterials | TrueMaterials:
        """Surface parameters at a :class:`neurad.core.records.SurfaceInteraction`."""
        return self.assembly.materials

    @property
    def radiance(self) -> RadianceField | None:
        """Reflected radiance L_theta(x, wo, n, albedo); None for a method without a radiance field, and in another
        light than that of the fit.
        """
        return self.assembly.radiance

    def surface(self, view: View | Camera | str) -> SurfaceInteraction:
        """What a view shows at its pixels' centres [h * w], row by row; ``valid`` is False where there is nothing."""
        camera = self._camera(view)
        pixel = torch.arange(camera.width * camera.height, device=self.device)
        xy = torch.stack((pixel % camera.width, pixel // camera.width), -1) + 0.5
        with torch.no_grad():
            return self.world.intersect(camera_rays(camera, xy))

    @property
    def maps(self) -> tuple[str, ...]:
        """Names of what :meth:`map` gives: ``albedo``, and what else the surfaces of the scene have."""
        return tuple(parameter.name for parameter in self.assembly.parameters)

    def map(self, name: str, points: Points) -> FloatArray:
        """A surface parameter [n, channels]: albedo, linear, Burley's roughness or metalness, in [0, 1].

        What was recovered depends on positions alone. On emitters nothing is recovered and the scene's own values hold,
        but a position does not say what lies there: use the points of :meth:`surface` where that matters.

        Args:
            name: one of :attr:`maps`.
            points: positions [n, 3] in the coordinates of the scene's files, or points of :meth:`surface`.

        Raises:
            InputError: the scene has no such parameter, ``points`` have another shape, or they are positions and the
                parameter is the scene's own.
        """
        if name not in self.maps:
            raise InputError(f"map {name}: scene {self.scene.name} has {', '.join(self.maps)}")
        if isinstance(points, SurfaceInteraction):
            return self._evaluate(lambda si: self.materials(si).parameters[name], points)
        fields = self._fields()
        if name not in fields.recovered and fields.metalness is None:
            raise InputError(f"map {name}: it is the scene's own: give points of run.surface(view)")
        return self._evaluate(lambda p: fields.at(p)[name], self._positions(points))

    @property
    def uncertain(self) -> tuple[str, ...]:
        """Names of the maps that :meth:`map_std` gives; none where the folder has no error bars."""
        if self.bars is None:
            return ()
        return tuple(self.bars.at(self._fields(), torch.zeros(1, 3, device=self.device)))

    def map_std(self, name: str, points: Points) -> FloatArray:
        """Standard deviation of a recovered map [n, channels]; 0 on emitters, where points of :meth:`surface` say so.

        Args:
            name: one of :attr:`maps` that is recovered.
            points: positions [n, 3] in world space, or points of :meth:`surface`.

        Raises:
            InputError: the parameter is not recovered, the run folder has no error bars, or others than those of this
                checkpoint, or a roughness refinement has not found them; or as :meth:`map`.
        """
        fields, bars = self._fields(), self._error_bars
        names = [*fields.recovered, *([METALLIC.name] if fields.metalness is not None else [])]
        if name not in names:
            raise InputError(f"map {name}: a run has error bars of {', '.join(names)}")
        if isinstance(points, SurfaceInteraction):
            emits = (self.world.geometry.emission > 0).any(-1)
            found = [bars_at(bars, fields, part, emits) for part in _chunks(points)]
        else:
            found = [bars.at(fields, part) for part in _chunks(self._positions(points))]
        if name not in found[0]:
            raise InputError(
                f"map {name}: this run knows no standard deviations of it, as its fit did not refine it; set "
                f"model.{name}.structure auto"
            )
        return np.concatenate([maps[name] for maps in found])

    def seen(self, points: Points) -> npt.NDArray[np.bool_]:
        """Whether some training photograph shows the points [n]; what none shows is a guess.

        Args:
            points: positions [n, 3] of surfaces in world space, or points of :meth:`surface`. Positions count as seen
                where nothing lies between them and the camera, whichever way their surface faces.

        Raises:
            InputError: ``points`` have another shape.
        """
        by = SeenBy.of(self.world.geometry, self.world.tracer, self.scene.train)
        if isinstance(points, SurfaceInteraction):
            return np.concatenate([by.any(part).cpu().numpy() for part in _chunks(points)])
        return np.concatenate([by.any_at(part).cpu().numpy() for part in _chunks(self._positions(points))])

    @property
    def bars(self) -> ErrorBars | None:
        """Error bars of the run; None where its folder has none, or others than those of this checkpoint."""
        try:
            return self._error_bars
        except InputError:
            return None

    @cached_property
    def _error_bars(self) -> ErrorBars:
        folder = run_folder_of(self.checkpoint)
        if folder is None:
            raise InputError(f"run {self.checkpoint}: its folder is gone, and the error bars with it")
        bars = read_bars(folder / NAME)
        if bars.iteration != self.iteration:
            raise InputError(
                f"{folder / NAME}: it is of iteration {bars.iteration}, the checkpoint of {self.iteration}; "
                "neurad test writes it anew"
            )
        return bars

    def render(self, view: View | Camera | str, spp: int = 16, seed: int = 0) -> FloatArray:
        """The method's picture (the right-hand side) of a view, as ``neurad test`` shows it.

        Args:
            view: a view of the scene or its name, or any camera.
            spp: samples per pixel.

        Returns:
            Linear radiance [h, w, 3].
        """
        estimator = self.assembly.estimator
        integrator = MethodRenderer(estimator.method, estimator)
        with torch.no_grad():
            picture = render(self._camera(view), integrator, spp, seed, self.device)
        return np.asarray(picture.cpu().numpy(), np.float32)

    def _camera(self, view: View | Camera | str) -> Camera:
        if isinstance(view, Camera):
            return camera_in_scene(view, self.scene)
        if isinstance(view, View):
            return view.camera
        views = {v.name: v for v in self.views}
        if view not in views:
            raise InputError(f"view {view}: scene {self.scene.name} has no view of that name")
        return views[view].camera

    def _fields(self) -> FittedMaterials:
        if not isinstance(self.materials, FittedMaterials):
            raise InputError("the materials of this run are the scene's own: give points of run.surface(view)")
        return self.materials

    def _positions(self, points: npt.ArrayLike) -> Tensor:
        p = np.asarray(points, np.float64)
        if p.ndim != 2 or p.shape[1] != 3:
            raise InputError(f"points: an array of shape [n, 3] is needed, not {list(p.shape)}")
        return torch.tensor(in_scene(p, self.scene), dtype=torch.float32, device=self.device)

    def _evaluate(self, values: Callable[[Any], Tensor], points: Tensor | SurfaceInteraction) -> FloatArray:
        """``values`` at points, in chunks, as an array."""
        with torch.no_grad():
            parts = [values(part).cpu() for part in _chunks(points)]
        return np.asarray(torch.cat(parts).numpy(), np.float32)


def _chunks(points: Tensor | SurfaceInteraction) -> list[Any]:
    """``points`` in parts of CHUNK, at least one."""
    return [points[i : i + CHUNK] for i in range(0, max(1, len(points)), CHUNK)]


def load_run(
    run: str | os.PathLike[str] | None = None,
    root: str | os.PathLike[str] | None = None,
    device: str | torch.device = "cpu",
    other_light: bool = True,
    trust: str | Sequence[str] = (),
) -> LoadedRun:
    """Read what a fit has recovered.

    Args:
        run: a run folder such as ``lightning_logs/version_3``, or a checkpoint in one; None or 'last' takes the newest
            run in ``lightning_logs``.
        root: where the scene's folder is now, if it has moved since the fit.
        device: where to put everything.
        other_light: whether the lamps and the environment of ``root`` may be others than in the fit. Pictures are then
            path traced, as the radiance field belongs to the light of the fit.
        trust: modules of the user's own, whose classes the run may name, as :func:`neurad.load` takes them.

    Raises:
        InputError: there is no such run, its checkpoint cannot be read or does not fit, its scene is missing or has
            changed, or its method is in a module that is not trusted.
    """
    trusted = import_trusted(trust)
    checkpoint, folder = _locate(run)
    name = f"run {checkpoint}"
    content = read_checkpoint(checkpoint, name)
    config = OmegaConf.to_container(own_config(folder, trusted))
    if not isinstance(config, dict) or not all(isinstance(config.get(part), dict) for part in ("model", "data")):
        raise InputError(f"{folder / 'config.yaml'}: it is not the config of a run")
    seed = config.get("seed_everything", 0)
    settings = parse_model(config["model"], str(folder / "config.yaml"), trusted, seed)
    reader = parse_reader(config["data"].get("reader"), str(folder / "config.yaml"), trusted)
    scene = without_surfaces(_scene(config["data"], folder, root, reader))
    finds = settings.lighting.emitters == "find"
    lamps = shining_from_state(content["neurad"].get("shining"), scene, name) if finds else None
    scene = lit_scene(scene, settings.lighting, lamps)
    if (poses := content["neurad"].get("poses")) is not None:
        scene = with_poses(scene, poses, name)
    if "flash" in (content["neurad"].get("radiance_inputs") or ()):  # also where the scene has none now
        settings = replace(settings, radiance=settings.radiance.resolved(scene.features.is_diffuse, flash=True))
    assembly = assemble(scene, settings, content["neurad"]["hide_environment"], fits=False)
    target = torch.device(device)
    state = _restore(assembly, content, name, target, other_light)
    changes = changed_light(state, scene, assembly.environment is None, assembly.lamps is None)
    if changes:
        assembly = in_other_light(assembly, fitted_lamps(state))
    return LoadedRun(checkpoint, int(state["iteration"]), assembly, target, tuple(changes))


def reload_run(run: LoadedRun) -> LoadedRun:
    """Read a run's checkpoint again into the parts that it has: the given run changes with the one that is returned.

    Raises:
        InputError: the checkpoint cannot be read or does not fit; nothing changes then.
    """
    name = f"run {run.checkpoint}"
    state = _restore(run.assembly, read_checkpoint(run.checkpoint, name), name, run.device, other_light=False)
    return replace(run, iteration=int(state["iteration"]))


def _locate(run: str | os.PathLike[str] | None) -> tuple[Path, Path]:
    if run is None or str(run) == "last":
        newest = newest_checkpoint(Path(), "")
        if newest is None:
            raise InputError("no run in lightning_logs has a checkpoint; --ckpt_path names one that lies elsewhere")
        path = newest
    else:
        path = expanded(run, "run")
        path = named_checkpoint(path, Path(), f"run {path}")
    folder = run_folder_of(path)
    if folder is None:
        raise InputError(f"run {path}: the checkpoint is not in a run folder with a config.yaml")
    return path, folder


def _scene(data: dict[str, Any], folder: Path, root: str | os.PathLike[str] | None, reader: Reader | None) -> Scene:
    """The scene of a run: in ``root``, else where the fit found it, seen from here or from where the fit began."""
    if data.get("root") is None and root is None:
        return load_scene(None, data.get("scene"), photography=Photography.of(data), hints=data.get("hints"))
    first = expanded(data["root"] if root is None else root, "--root")
    places = [first] if root is not None or first.is_absolute() else [first, folder.parent.parent / first]
    place = next((place for place in places if place.is_dir()), None)
    if place is None:
        raise InputError(
            f"run {folder}: its scene {first} is missing; say where it is now with --root (in Python, root=)"
        )
    held_out, hints = data.get("hold_out", HOLD_OUT), data.get("hints")
    return load_scene(str(place), None, held_out, Photography.of(data), hints, reader)


def _restore(
    assembly: Assembly, checkpoint: dict[str, Any], name: str, device: torch.device, other_light: bool
) -> dict[str, Any]:
    """Copy the checkpoint's weights into the parts on a device, and return what the run wrote about itself."""
    own = {f"{part}.{key}": value for part, module in assembly.modules() for key, value in module.state_dict().items()}
    state = fitting(checkpoint, own, assembly.scene, assembly.radiance_inputs, name, other_light=other_light)
    for part, module in assembly.modules():
        prefix = f"{part}."
        weights = checkpoint["state_dict"]
        module.load_state_dict({k.removeprefix(prefix): v for k, v in weights.items() if k.startswith(prefix)})
        module.to(device)
    if assembly.average is not None:
        assembly.average.copy_to_module()
    return state
