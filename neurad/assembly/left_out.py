"""Pixels of photographs that show surfaces which the user leaves out."""

import numpy as np
import torch

from neurad.core.camera import camera_rays
from neurad.core.protocols import Tracer
from neurad.core.records import BoolArray
from neurad.core.scene_records import Camera
from neurad.scene.description import Scene, leaving_out
from neurad.scene.geometry import Geometry
from neurad.scene.hints import PlaceHint
from neurad.scene.parts import SurfaceParts
from neurad.tracing.select import make_tracer

_ROWS = 64  # of pixels that are traced at a time


def without_surfaces(scene: Scene) -> Scene:
    """The scene, of whose views every pixel is left out that sees a surface which its hints leave out: the connected
    part of a mesh that a point lies on, or the triangles within a box.

    Raises:
        InputError: nothing is at such a place.
    """
    hints = [part for part in scene.hints.leave_out if isinstance(part, PlaceHint)]
    if not hints:
        return scene
    geometry = Geometry(scene)
    vertices, faces = geometry.vertices.numpy(), geometry.faces.numpy()
    part = SurfaceParts(geometry, geometry.mesh_index).of(torch.arange(len(faces))).numpy()
    hidden = np.zeros(len(faces), bool)
    for hint in hints:
        inside = hint.triangles(vertices, faces, scene.origin)
        hidden |= inside if hint.is_box else part == part[inside]
    tracer = make_tracer("auto", geometry.vertices, geometry.faces)
    views = (*scene.train, *scene.test)
    return leaving_out(scene, {view.name: pixels_that_see(view.camera, tracer, hidden) for view in views})


@torch.no_grad()
def pixels_that_see(camera: Camera, tracer: Tracer, triangles: BoolArray) -> BoolArray:
    """Pixels [h, w] in whose middle or at one of whose corners one of these triangles [f], bool, is seen."""

    def seen(columns: torch.Tensor, rows: torch.Tensor) -> BoolArray:
        found = []
        for some in torch.split(rows, _ROWS):
            xy = torch.stack(torch.meshgrid(columns, some, indexing="xy"), -1).view(-1, 2)
            hit = tracer.closest(camera_rays(camera, xy))
            found.append((triangles[hit.prim.clamp_min(0).numpy()] & hit.valid.numpy()).reshape(len(some), -1))
        return np.concatenate(found)

    corner = seen(torch.arange(camera.width + 1.0), torch.arange(camera.height + 1.0))
    middle = seen(torch.arange(camera.width) + 0.5, torch.arange(camera.height) + 0.5)
    return np.asarray(middle | corner[:-1, :-1] | corner[1:, :-1] | corner[:-1, 1:] | corner[1:, 1:])
