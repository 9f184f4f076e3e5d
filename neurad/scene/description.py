"""A scene as it was described, before anything is built from it."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from neurad.core.errors import InputError, Refusals
from neurad.core.parameters import ALBEDO, METALLIC, ROUGHNESS, SurfaceParameter
from neurad.core.records import BoolArray, FloatArray
from neurad.core.reflection import DiffuseLobe, DiffuseModel, PrincipledModel, ReflectionModel
from neurad.core.scene_records import Constant, EnvironmentMap, Material, Mesh, PunctualLight, Texture, View
from neurad.images.development import KNOWN, Photography
from neurad.runtime.numbers import RADIANCE, within
from neurad.scene.hints import NO_HINTS, Hints
from neurad.scene.punctual import check_punctual

SCORED = 8
"""Training photographs that are scored where no view is held out."""


def is_dielectric(metallic: Texture) -> bool:
    """Whether a metalness is 0 everywhere."""
    return isinstance(metallic, Constant) and not metallic.value.any()


def is_used(mesh: Mesh) -> npt.NDArray[np.bool_]:
    """Which vertices of a mesh belong to a triangle [v]."""
    used = np.zeros(len(mesh.vertices), bool)
    used[mesh.faces.ravel()] = True
    return used


@dataclass(frozen=True)
class Features:
    """What a scene has. Parts that it does not need are not built."""

    has_environment: bool
    has_area_lights: bool
    has_delta: bool
    """Smooth conductors or dielectrics: paths pass through them to the first other vertex."""
    is_diffuse: bool
    """Every surface that is not delta is Lambertian: no roughness, no specular lobe."""
    has_one_sided: bool
    """Some surface is black from behind."""
    models: tuple[ReflectionModel, ...] = ()
    """The reflection models of all surfaces that are not delta, each once; ``Surface.model`` counts them."""
    has_punctual: bool = False
    """Points, spots or directional lights."""
    has_flash: bool = False
    """A light that moves with the camera, in some view."""

    @property
    def has_light(self) -> bool:
        """Whether anything shines at all."""
        return self.has_area_lights or self.has_environment or self.has_punctual or self.has_flash

    @property
    def fitted_model(self) -> ReflectionModel:
        """The model that recovered surfaces have: Lambertian in a Lambertian scene, else principled, with the diffuse
        lobe of the scene's own principled materials if these agree.
        """
        if self.is_diffuse:
            return DiffuseModel()
        own = {model.diffuse for model in self.models if isinstance(model, PrincipledModel)}
        return PrincipledModel(diffuse=own.pop() if len(own) == 1 else "burley")

    @property
    def is_mixed(self) -> bool:
        """Some known surface has another model than recovered ones have."""
        return any(model != self.fitted_model for model in self.models)


@dataclass(frozen=True)
class Scene:
    """Geometry, materials, lights and cameras. Arrays are numpy; the tracing and shading floors build from them."""

    name: str
    meshes: list[Mesh]
    materials: list[Material]
    environment: EnvironmentMap | None = None
    train: list[View] = field(default_factory=list)
    test: list[View] = field(default_factory=list)
    max_depth: int = 20
    """Longest path in vertices with reflection counted from 1 (direct light is 2), as Mitsuba's ``max_depth``."""
    rr_depth: int = 8
    """Depth from which roulette may end a path, as Mitsuba's ``rr_depth``."""
    relight: str | None = None
    """Path of another environment map (EXR), under which held-out views were photographed again; for metrics only."""
    notes: tuple[str, ...] = ()
    """What the readers decided for the user, a sentence each."""
    punctual: tuple[PunctualLight, ...] = ()
    """Lights without extent."""
    photography: Photography = KNOWN
    """What is known of how the photographs were taken."""
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """What was subtracted from all coordinates of the scene's files, see :mod:`neurad.scene.origin`."""
    hints: Hints = NO_HINTS
    """What the user says of places in it."""

    @property
    def radiance(self) -> FloatArray:
        """That of each mesh [m, 3]; 0 of those that do not shine."""
        shown = [np.zeros(3) if mesh.radiance is None else mesh.radiance for mesh in self.meshes]
        return np.array(shown, np.float32).reshape(-1, 3)

    @property
    def diffuse(self) -> DiffuseLobe | None:
        """The diffuse lobe of its principled materials, where they agree and it is not Burley's as in Mitsuba."""
        model = self.features.fitted_model
        return "lambert" if isinstance(model, PrincipledModel) and model.diffuse == "lambert" else None

    def with_diffuse(self, lobe: DiffuseLobe) -> Scene:
        """The scene with this diffuse lobe in its principled materials."""
        return replace(self, materials=[
            replace(m, model=replace(m.model, diffuse=lobe)) if isinstance(m.model, PrincipledModel) else m
            for m in self.materials
        ])  # fmt: skip

    def check(self, lit: bool = True) -> Scene:
        """This scene, if light transport can be computed in it.

        Args:
            lit: refuse a scene in which nothing shines; False where what shines is still to be found.

        Raises:
            InputError: no triangle at all, a mesh without triangles, radiance that is no number to compute with, or
                nothing that emits light.
        """
        if not self.meshes:
            raise InputError(f"scene {self.name}: it has no mesh")
        refusals = Refusals()
        for mesh in self.meshes:
            with refusals.part():
                check_mesh(mesh, self.materials[mesh.material], f"scene {self.name}: ")
        refusals.end()
        if self.environment is not None:
            within(self.environment.pixels, f"scene {self.name}: the radiance of its environment", 0.0, RADIANCE)
        for light in self.punctual:
            check_punctual(light, f"scene {self.name}: {light.kind} emitter {light.name}")
        flashes = [view.camera.flash for view in (*self.train, *self.test) if view.camera.flash is not None]
        if len({(light.kind, light.cutoff_angle, light.beam_width) for light in flashes}) > 1:
            raise InputError(f"scene {self.name}: its flashes differ in type or angles, which is not supported")
        if lit and not self.features.has_light:
            raise InputError(f"scene {self.name}: it has no emitter, so every photograph would be black")
        return self

    @cached_property
    def scored(self) -> list[View]:
        """The views that scores are of: those held out or, where there are none, a few training photographs, evenly
        over all, without true maps.
        """
        if self.test or not self.train:
            return self.test
        few = min(SCORED, len(self.train))
        chosen = [self.train[i * len(self.train) // few] for i in range(few)]
        return [replace(view, maps={}, relight=None) for view in chosen if view.image is not None]

    @property
    def scores_are_of(self) -> str | None:
        """What has to be said of scores, where they are not of held-out views; None where they are."""
        if self.test or not self.scored:
            return None
        return (
            f"scene {self.name}: no view is held out, so scores are of {len(self.scored)} photographs that the fit "
            "learns from: they say how well these are reproduced, not how right the materials are"
        )

    @cached_property
    def features(self) -> Features:
        """What the meshes, materials and emitters of this scene use."""
        used = [self.materials[i] for i in sorted({mesh.material for mesh in self.meshes})]
        delta = [m for m in used if m.model.is_delta]
        rough = [m for m in used if not m.model.is_delta]
        return Features(
            has_environment=self.environment is not None and bool(self.environment.pixels.max() > 0),
            has_area_lights=any(m.radiance is not None and bool(m.radiance.max() > 0) for m in self.meshes),
            has_delta=bool(delta),
            is_diffuse=all(m.model.is_diffuse for m in rough),
            has_one_sided=any(not m.two_sided for m in rough),
            models=tuple(dict.fromkeys(m.model for m in rough)),
            has_punctual=any(bool(light.intensity.any()) for light in self.punctual),
            has_flash=self.flash is not None,
        )

    @property
    def flash(self) -> PunctualLight | None:
        """A flash of its photographs; None where none has one that shines."""
        lights = (view.camera.flash for view in (*self.train, *self.test))
        return next((light for light in lights if light is not None and light.intensity.any()), None)

    @property
    def replaced(self) -> list[str]:
        """Materials that a fit recovers with another model than they have, as ``name (model)``: all that are not smooth
        and not on emitters alone, as those are known. Of a model that is not supported it says what is not.
        """
        recovered = sorted({mesh.material for mesh in self.meshes if mesh.radiance is None})
        used = [self.materials[i] for i in recovered if not self.materials[i].model.is_delta]
        return [f"{m.name} ({m.model.label})" for m in used if m.model != self.features.fitted_model]

    @cached_property
    def smooth_meshes(self) -> frozenset[int]:
        """Indices of the meshes that are smooth mirrors or glass."""
        return frozenset(i for i, mesh in enumerate(self.meshes) if self.materials[mesh.material].model.is_delta)

    @cached_property
    def parameters(self) -> tuple[SurfaceParameter, ...]:
        """What its surfaces have: albedo; roughness unless all are Lambertian; metalness if one of them has any."""
        if self.features.is_diffuse:
            return (ALBEDO,)
        used = [self.materials[i] for i in {mesh.material for mesh in self.meshes}]
        has_metal = any(not m.model.is_delta and not is_dielectric(m.metallic) for m in used)
        return (ALBEDO, ROUGHNESS, METALLIC) if has_metal else (ALBEDO, ROUGHNESS)

    @cached_property
    def bounds(self) -> FloatArray:
        """Smallest and largest corner of the triangles [2, 3]; vertices that none of them uses do not count."""
        used = [m.vertices[is_used(m)] for m in self.meshes]
        low = np.min([vertices.min(axis=0) for vertices in used], axis=0)
        high = np.max([vertices.max(axis=0) for vertices in used], axis=0)
        return np.stack((low, high)).astype(np.float32)

    @cached_property
    def geometry_fingerprint(self) -> str:
        """A hash of the triangles: a checkpoint fits a scene only if it agrees."""
        digest = hashlib.sha256()
        for mesh in self.meshes:
            digest.update(np.ascontiguousarray(mesh.vertices, np.float32).tobytes())
            digest.update(np.ascontiguousarray(mesh.faces, np.int64).tobytes())
        return digest.hexdigest()[:16]


def check_mesh(mesh: Mesh, material: Material, where: str) -> None:
    """Check that light transport can be computed with a mesh of a material, ``where`` as the sentence begins.

    Raises:
        InputError: it has no triangle, radiance that is no number to compute with, or it shines and is smooth.
    """
    if len(mesh.faces) == 0:
        raise InputError(f"{where}mesh {mesh.name} is empty, it has no triangle")
    if mesh.radiance is None:
        return
    within(mesh.radiance, f"{where}the radiance of mesh {mesh.name}", 0.0, RADIANCE)
    if material.model.is_delta:
        raise InputError(f"{where}mesh {mesh.name} emits light and is smooth, which is not supported; make it rough")


def leaving_out(scene: Scene, left_out: Mapping[str, BoolArray]) -> Scene:
    """The scene, in whose views of these names the pixels [h, w] are left out as well."""

    def without(view: View) -> View:
        more = left_out.get(view.name)
        if more is None or not more.any():
            return view
        return replace(view, left_out=more if view.left_out is None else more | view.left_out)

    return replace(scene, train=[without(view) for view in scene.train], test=[without(view) for view in scene.test])
