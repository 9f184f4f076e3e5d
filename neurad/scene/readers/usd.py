"""Meshes of USD files, read by the optional ``usd-core``."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from neurad.core.errors import InputError
from neurad.core.names import apart
from neurad.core.records import IntArray, Mesh
from neurad.runtime.reading import native, shown
from neurad.scene.numbers import LENGTH, RADIANCE, unit, within

Array = npt.NDArray[Any]

_SURFACES = ("Sphere", "Cube", "Cylinder", "Cone", "Capsule", "Plane", "NurbsPatch", "PointInstancer", "TetMesh")
"""Kinds of prims that have a surface and are no meshes."""
_FLAT = ("none", "bilinear")  # ways of subdivision that leave a surface as its faces have it


def read_usd(path: Path) -> list[Mesh]:
    """The visible meshes of a file in the frame of its stage, instances each where they stand, with what their
    materials emit (a constant ``emissiveColor`` of ``UsdPreviewSurface``).

    Raises:
        InputError: the package is missing, the file is broken, or has surfaces that are no meshes.
    """
    try:
        from pxr import Usd, UsdGeom
    except ImportError as error:
        raise InputError(f"{shown(path)}: reading it needs the package usd-core: pip install 'neurad[usd]'") from error
    with native(path, "it cannot be read as USD"):
        stage = Usd.Stage.Open(str(path))
        prims = list(stage.Traverse(Usd.TraverseInstanceProxies()))
        placed = UsdGeom.XformCache()
        meshes: list[Mesh] = []
        for prim in prims:
            kind = str(prim.GetTypeName())
            if kind != "Mesh" and kind not in _SURFACES:
                continue
            seen = UsdGeom.Imageable(prim)
            if seen.ComputeVisibility() == UsdGeom.Tokens.invisible or seen.ComputePurpose() in ("proxy", "guide"):
                continue
            if kind != "Mesh":
                raise InputError(
                    f"{shown(path)}: {shown(prim.GetPath())} is a {kind}; only meshes are read, convert it"
                )
            to_world = np.array(placed.GetLocalToWorldTransform(prim), np.float64).T
            meshes += _meshes(path, prim, UsdGeom.Mesh(prim), to_world)
    if not meshes:
        raise InputError(f"{shown(path)}: it has no triangle")
    return _named_apart(meshes)


def _meshes(path: Path, prim: Any, mesh: Any, to_world: Array) -> Iterator[Mesh]:
    """The mesh of a prim, unless it has no faces."""
    where = f"{shown(path)}: mesh {shown(prim.GetPath())}"
    scheme = mesh.GetSubdivisionSchemeAttr()
    if scheme.HasAuthoredValue() and str(scheme.Get()) not in _FLAT:
        raise InputError(f"{where} is a surface of {scheme.Get()} subdivision; apply that before it is exported")
    points = np.asarray(mesh.GetPointsAttr().Get() or (), np.float64).reshape(-1, 3)
    counts = np.asarray(mesh.GetFaceVertexCountsAttr().Get() or (), np.int64)
    order = np.asarray(mesh.GetFaceVertexIndicesAttr().Get() or (), np.int64)
    if len(counts) == 0 or counts.sum() == 0:
        return
    if counts.min() < 3 or counts.sum() != len(order) or order.min() < 0 or order.max() >= len(points):
        raise InputError(f"{where} has faces that name vertices that there are not, or fewer than three")
    corners = _fans(counts)
    within(points, f"{where}: its points", -LENGTH, LENGTH)
    linear = to_world[:3, :3]
    if abs(np.linalg.det(linear)) <= 1e-12 * np.linalg.norm(linear, axis=0).prod():
        raise InputError(f"{where}: its transform flattens it (it cannot be inverted)")
    from pxr import UsdGeom

    left = mesh.GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded
    if left != (np.linalg.det(linear) < 0):
        corners = corners[:, [0, 2, 1]]
    vertices, faces, normals = points, order[corners], None
    given = _normals(mesh, len(points), counts, order)
    if given is not None:
        if len(given) != len(points):  # of corners: each gets a vertex of its own
            vertices, faces = points[order], corners
        normals = unit(given @ np.linalg.inv(linear))
    there: Any = vertices @ linear.T + to_world[:3, 3]
    within(there, f"{where}: its coordinates", -LENGTH, LENGTH)
    smooth = None if normals is None else normals.astype(np.float32)
    yield Mesh(str(prim.GetName()), there, faces.astype(np.int64), 0, smooth, radiance=_emitted(prim, where))


def _fans(counts: IntArray) -> IntArray:
    """Polygons as triangles around their first corners: places among all corners [f, 3]."""
    first = np.repeat(np.cumsum(counts) - counts, counts - 2)
    step = np.arange(len(first)) - np.repeat(np.cumsum(counts - 2) - (counts - 2), counts - 2)
    return np.stack((first, first + step + 1, first + step + 2), -1)


def _normals(mesh: Any, count: int, counts: IntArray, order: IntArray) -> Array | None:
    """Normals of the vertices or of the corners; None where the file has none of the right number, or all are one a
    face.
    """
    values, kind = mesh.GetNormalsAttr().Get(), str(mesh.GetNormalsInterpolation())
    from pxr import UsdGeom

    primvar = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("normals")
    if primvar and primvar.HasValue():  # goes before the attribute
        values, kind = primvar.ComputeFlattened(), str(primvar.GetInterpolation())
    array: Array = np.asarray(values if values is not None else (), np.float64).reshape(-1, 3)
    wanted = {"vertex": count, "varying": count, "faceVarying": len(order)}.get(kind)
    return array if wanted == len(array) and np.isfinite(array).all() else None


def _emitted(prim: Any, where: str) -> Array | None:
    """What the material of a prim emits."""
    from pxr import UsdShade

    material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0]
    shader = material.ComputeSurfaceSource()[0] if material else None
    glow = shader.GetInput("emissiveColor") if shader else None
    if not glow:
        return None
    if glow.HasConnectedSource():
        raise InputError(f"{where} shines by a picture, which is not read from USD; export glTF instead")
    radiance: Array = np.asarray(glow.Get() if glow.Get() is not None else (0, 0, 0), np.float32).reshape(3)
    within(radiance, f"{where}: its emissiveColor", 0.0, RADIANCE)
    return radiance if radiance.any() else None


def _named_apart(meshes: list[Mesh]) -> list[Mesh]:
    taken: set[str] = set()
    return [replace(mesh, name=apart(mesh.name, taken)) for mesh in meshes]
