"""What ``neurad render`` renders: a scene with its true materials, or what a run recovered, after an edit of either."""

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

from neurad.assembly.build import build_world
from neurad.assembly.fitted_materials import FittedMaterials
from neurad.assembly.relight import EditedMaterials, paths, recovered_scene, relit
from neurad.core.errors import InputError
from neurad.core.parameters import METALLIC, SurfaceParameter
from neurad.core.protocols import Integrator
from neurad.core.scene_records import Camera
from neurad.core.suggest import did_you_mean
from neurad.fields.radiance import RadianceField
from neurad.formats.edits.edit import Edit, edited
from neurad.formats.load import load_scene
from neurad.formats.reader import Reader
from neurad.integrators.method import Method, ReflectedRadiance, SceneModel
from neurad.integrators.path import PathTracing
from neurad.integrators.renderer import FieldRenderer, MethodRenderer
from neurad.runs.configs import shipped_methods
from neurad.runs.load import load_run
from neurad.runs.model_settings import model_settings, parse_model
from neurad.runtime.progress import phase
from neurad.scene.description import Scene
from neurad.scene.textures import TrueMaterials
from neurad.training.train_radiance import train_radiance

SEED = 20230806
SPREAD = 16
"""Samples of a pixel whose first bounces are spread evenly; more are several such sets."""


@dataclass(frozen=True)
class Subject:
    """A world and its materials, and the method that renders them."""

    scene: Scene
    parts: SceneModel
    method: Method
    field: ReflectedRadiance | None = None
    """The radiance field of a run whose light and materials are as they were; None where one has to be learned."""
    said: tuple[str, ...] = ()
    """What is other than in the scene or the run, a few words each."""

    @property
    def parameters(self) -> tuple[SurfaceParameter, ...]:
        """What its surfaces have, metal that a run has found included."""
        own, materials = self.scene.parameters, self.parts.materials
        fields = materials.fields if isinstance(materials, EditedMaterials) else materials
        metalness = fields.metalness if isinstance(fields, FittedMaterials) else None
        return own if METALLIC in own or metalness is None or not metalness.found else (*own, METALLIC)

    def integrators(self, cameras: Sequence[Camera], steps: int, seconds: float | None) -> dict[str, Integrator]:
        """What renders the pictures, by the folder that they go to; learns the radiance field where one is read, for so
        many steps and seconds at most.
        """
        if not self.method.needs_field:
            return {"images": MethodRenderer(self.method, self.parts, SPREAD)}
        field = self._learned(cameras, steps, seconds) if self.field is None else self.field
        parts = replace(self.parts, radiance=field)
        return {"images": MethodRenderer(self.method, parts, SPREAD), "images_lhs": FieldRenderer(parts)}

    def _learned(self, cameras: Sequence[Camera], steps: int, seconds: float | None) -> RadianceField:
        """The radiance field of this light and these materials."""
        start = time.perf_counter()

        def report(step: int, loss: float) -> None:
            training.step(step - training.done, f"loss {loss:.3g}")
            print(f"radiance field: step {step}, {time.perf_counter() - start:.0f} s, loss {loss:.4g}", file=sys.stderr)

        seen = [view.camera for view in (*self.scene.train, *self.scene.test)]
        model = model_settings("scene.yaml", SEED)
        with phase("training", None if seconds else steps, seconds) as training:
            world, materials = self.parts.world, self.parts.materials
            return train_radiance(self.scene, world, materials, [*seen, *cameras], model, steps, seconds, report)


def true_subject(
    root: str | None,
    name: str | None,
    edit: Edit,
    integrator: str | None,
    max_depth: int | None,
    tracer: str,
    reader: Reader | None = None,
) -> Subject:
    """A scene with its own materials, edited, along paths of its own depth unless ``max_depth`` says another.

    Raises:
        InputError: unknown scene or method, unreadable files, or an edit that does not fit.
    """
    method = _find_method(integrator or "path", max_depth)
    made = edited(load_scene(root, name, photography=None, reader=reader), edit)
    world = build_world(made.scene, tracer)
    parts = SceneModel(world, TrueMaterials(made.scene, world.geometry))
    return Subject(made.scene, parts, _deepened(method, made.scene, max_depth), said=made.said)


def recovered_subject(
    ckpt_path: str,
    root: str | None,
    edit: Edit,
    integrator: str | None,
    max_depth: int | None,
    trust: Sequence[str],
) -> Subject:
    """What a run recovered, edited, perhaps in the other light of a scene folder ``root``.

    Without the name of an integrator the method is the run's own where nothing is changed, otherwise paths, as long as
    the scene's unless ``max_depth`` says another.

    Raises:
        InputError: no such run or method, a scene of other geometry, or an edit that does not fit.
    """
    given = None if integrator is None else _find_method(integrator, max_depth)
    run = load_run(ckpt_path, root, trust=trust)
    made = edited(recovered_scene(run.assembly), edit)
    said = (*run.light_changes, *made.said)
    own = run.settings.method
    if not said and (max_depth is None if given is None else type(given) is type(own)):
        return Subject(run.scene, SceneModel(run.assembly.world, run.assembly.materials), own, run.radiance)
    method = _deepened(paths(made.scene) if given is None else given, made.scene, max_depth)
    parts = relit(run.assembly, made)
    return Subject(made.scene, SceneModel(parts.world, parts.materials), method, said=said)


def _deepened(method: Method, scene: Scene, max_depth: int | None) -> Method:
    """A method of paths with the depth that is wanted, or that of the scene; any other as it is."""
    if not isinstance(method, PathTracing):
        return method
    return type(method)(max_depth or scene.max_depth, scene.rr_depth)


def _find_method(name: str, max_depth: int | None) -> Method:
    """A method by its name, with the settings of its overlay.

    Raises:
        InputError: there is none of this name, or it has no depth to choose and one is given.
    """
    found = shipped_methods()
    if name not in found:
        near = did_you_mean(name, found)
        raise InputError(f"--integrator: there is no method {name} ({', '.join(sorted(found))}){near}")
    method = parse_model({"method": found[name]}, f"--integrator {name}").method
    if max_depth is not None and not isinstance(method, PathTracing):
        raise InputError(f"--max-depth: only paths have a depth, --integrator {name} has none to choose")
    return method
