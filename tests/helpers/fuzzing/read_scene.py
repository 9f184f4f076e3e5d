"""What a fit reads before its first step, and a picture of it: everything finite, or one sentence."""

from pathlib import Path

import numpy as np
import torch


def read_scene(root: Path) -> None:
    """Read a scene folder like a fit and render one sample a pixel of its first view.

    Raises:
        InputError: the folder is bad.
        AssertionError: something was read that is no number.
    """
    from datamodules.scene_data import SceneData
    from datamodules.settings import DataSettings
    from neurad.assembly.build import build_world
    from neurad.integrators.film import render
    from neurad.integrators.renderer import path_tracer
    from neurad.metrics.held_out import HeldOut
    from neurad.metrics.held_out_scores import relight_map
    from neurad.scene.textures import TrueMaterials

    data = SceneData(DataSettings(root=str(root)))
    data.setup("fit")
    scene = data.scene
    for view in (*scene.train, *scene.test):
        finite("a camera", view.camera.to_world, view.camera.fov_x)
    for mesh in scene.meshes:
        finite(f"mesh {mesh.name}", mesh.vertices, *mesh.attributes.values())
        finite(f"mesh {mesh.name}", *(x for x in (mesh.normals, mesh.uvs, mesh.radiance) if x is not None))
        inside = (mesh.faces >= 0) & (mesh.faces < len(mesh.vertices))
        assert inside.all(), f"mesh {mesh.name}: an index of no vertex"
        assert mesh.radiance is None or mesh.radiance.min() >= 0, f"mesh {mesh.name}: negative light"
    if scene.environment is not None:
        finite("the environment", scene.environment.pixels, scene.environment.to_world)
        assert scene.environment.pixels.min() >= 0, "the environment: negative light"
    finite("the photographs", data.photographs)
    world = build_world(scene, hide_environment=data.has_alpha)
    held_out = HeldOut(scene, world.geometry, world.tracer).read()
    for index in range(len(scene.test)):
        finite(f"held-out view {index}", *held_out.truth(index).values())
    relit = relight_map(scene)
    if relit is not None:
        finite("the other environment", relit.pixels)
    if any(model.unsupported for model in scene.features.models):
        return
    materials = TrueMaterials(scene, world.geometry)
    for name, buffer in materials.named_buffers():
        if buffer.is_floating_point():
            finite(f"the materials' {name}", buffer)
    for texture in materials.fields.values():
        for values in (texture.table.constant, texture.table.texels):
            assert values.numel() == 0 or (values.min() >= 0.0 and values.max() <= 1.0), "a material outside [0, 1]"
    integrator = path_tracer(world, materials, min(scene.max_depth, 4), scene.rr_depth)
    finite("a picture", render(scene.train[0].camera, integrator, 1, 0))


def finite(what: str, *values: object) -> None:
    """Raise if some of the values are not numbers."""
    for value in values:
        array = value.detach().numpy() if isinstance(value, torch.Tensor) else np.asarray(value)
        if array.dtype.kind == "f":
            assert np.isfinite(array).all(), f"{what}: NaN or infinite"
