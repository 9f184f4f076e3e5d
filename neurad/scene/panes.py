"""Panes of glass that are a single sheet: of solid glass light that enters them never leaves."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from neurad.core.reflection import DielectricModel
from neurad.core.scene_records import Material, Mesh
from neurad.runtime.reading import shown
from neurad.scene.connected import connected_parts
from neurad.scene.description import Scene

_OPEN = 0.1
"""Part of a surface's area that its normals add up to, from which on it is a sheet: of a closed one they cancel."""
_BESIDE = 0.2
"""Distance of two sheets over the square root of their area up to which they are the sides of one pane."""
_OPPOSITE = -0.9  # cosine between the sides of a pane
_LISTED = 6


def single_sheets(meshes: Sequence[Mesh], materials: Sequence[Material], thin: bool = False) -> list[str]:
    """Names of meshes of solid glass, or of ``thin`` glass, that have a sheet without another side."""
    names, sheets = list[str](), list[np.ndarray]()
    for mesh in meshes:
        model = materials[mesh.material].model
        if not isinstance(model, DielectricModel) or model.thin != thin or len(mesh.faces) == 0:
            continue
        p = mesh.vertices[mesh.faces].astype(np.float64)
        across = 0.5 * np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
        area, part = np.linalg.norm(across, axis=1), connected_parts(mesh.vertices, mesh.faces)
        total = np.bincount(part, area)
        sums = [np.bincount(part, column) for column in (*across.T, *(area[:, None] * p.mean(1)).T)]
        for index in np.flatnonzero(np.linalg.norm(sums[:3], axis=0) > _OPEN * total):
            middle = [column[index] / total[index] for column in sums[3:]]
            sheets.append(np.array([*(column[index] for column in sums[:3]), *middle, total[index]]))
            names.append(mesh.name)
    if not sheets:
        return []
    rows = np.stack(sheets)
    normal = rows[:, :3] / np.linalg.norm(rows[:, :3], axis=1, keepdims=True)
    found = []
    for place, row in enumerate(rows):
        near = np.linalg.norm(rows[:, 3:6] - row[3:6], axis=1) < _BESIDE * np.sqrt(row[6])
        if not (near & (normal @ normal[place] < _OPPOSITE)).any():
            found.append(names[place])
    return list(dict.fromkeys(found))


def closed_made_solid(meshes: Sequence[Mesh], materials: Sequence[Material]) -> tuple[list[Mesh], list[Material]]:
    """Meshes and materials of a file that says of no glass whether it is solid, all of it thin as it comes: what is no
    single sheet becomes solid.
    """
    sheets = set(single_sheets(meshes, materials, thin=True))
    made, found, solid = list(materials), list[Mesh](), dict[int, int]()
    for mesh in meshes:
        material = materials[mesh.material]
        if isinstance(material.model, DielectricModel) and material.model.thin and mesh.name not in sheets:
            if mesh.material not in solid:
                solid[mesh.material] = len(made)
                made.append(replace(material, model=replace(material.model, thin=False)))
            mesh = replace(mesh, material=solid[mesh.material])
        found.append(mesh)
    return found, made


def pane_note(scene: Scene) -> list[str]:
    """What is to be said of :func:`single_sheets`: a sentence, or nothing."""
    names = single_sheets(scene.meshes, scene.materials)
    if not names:
        return []
    listed = ", ".join(shown(name) for name in names[:_LISTED]) + (" ..." if len(names) > _LISTED else "")
    return [
        f"warning: glass of a single sheet ({listed}) is the surface of a block that never ends: light that enters it "
        "is bent once and never leaves; give the pane a second side and a thickness (Solidify in Blender), make it a "
        "thindielectric in scene.xml, or take it out"
    ]
