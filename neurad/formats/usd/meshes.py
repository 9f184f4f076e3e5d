"""Meshes and materials of USD."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from pxr import Usd, UsdGeom, UsdShade

from neurad.core.errors import InputError
from neurad.core.records import Array, FloatArray, IntArray
from neurad.runtime.numbers import LENGTH, RADIANCE, within
from neurad.runtime.reading import shown
from neurad.scene.polygons import triangulate_polygons

FLAT = ("none", "bilinear")
"""Ways of subdivision that leave a surface as its faces have it."""
PREVIEW = "UsdPreviewSurface"
_CONTEXTS = ("", "mtlx", "mdl", "ri", "arnold")


@dataclass(frozen=True)
class Part:
    """The faces of a mesh that have one material."""

    subset: Any
    """The prim of a GeomSubset; None for what is in none."""
    points: Array
    """[v, 3], float64, in the mesh's own frame."""
    faces: IntArray
    """[f, 3], counterclockwise from outside in a right-handed frame."""
    normals: Array | None
    """[v, 3], in the mesh's own frame."""


@dataclass(frozen=True)
class Look:
    """What a material says."""

    name: str
    emitted: FloatArray | None
    """Radiance [3]; None of what does not shine."""
    is_metal: bool
    unread: str | None
    """The shader that may shine and is not read."""


def face_count(mesh: Any, time: Any) -> int:
    """Triangles of a mesh, at most."""
    counts = np.asarray(mesh.GetFaceVertexCountsAttr().Get(time) or (), np.int64)
    return int(np.maximum(counts - 2, 0).sum())


def parts_of(prim: Any, mesh: Any, time: Any, where: str) -> tuple[list[Part], int]:
    """The parts of a mesh, none of what has no face, and the number of its polygons whose edges cross.

    Raises:
        InputError: its arrays do not fit one another, a number is none to compute with, or it is to be subdivided.
    """
    scheme = mesh.GetSubdivisionSchemeAttr()
    if scheme.HasAuthoredValue() and str(scheme.Get(time)) not in FLAT:
        raise InputError(f"{where} is a surface of {scheme.Get(time)} subdivision; apply that before it is exported")
    points = np.asarray(mesh.GetPointsAttr().Get(time) or (), np.float64).reshape(-1, 3)
    counts = np.asarray(mesh.GetFaceVertexCountsAttr().Get(time) or (), np.int64)
    order = np.asarray(mesh.GetFaceVertexIndicesAttr().Get(time) or (), np.int64)
    if len(counts) == 0 or counts.sum() == 0:
        return [], 0
    if counts.min() < 3 or counts.sum() != len(order) or order.min() < 0 or order.max() >= len(points):
        raise InputError(f"{where} has faces that name vertices that there are not, or fewer than three")
    within(points, f"{where}: its points", -LENGTH, LENGTH)
    subset_of, subsets = _subsets(prim, len(counts), time, where)
    holes = np.asarray(mesh.GetHoleIndicesAttr().Get(time) or (), np.int64)
    subset_of[holes[(holes >= 0) & (holes < len(counts))]] = -1
    corners, crossing = triangulate_polygons(points[order], counts)
    part = subset_of[np.searchsorted(np.cumsum(counts), corners[:, 0], side="right")]
    left = str(mesh.GetOrientationAttr().Get(time)) == "leftHanded"
    corners = corners[:, [0, 2, 1]] if left else corners
    given = _normals(mesh, len(points), len(order), time)
    vertices, faces = (
        (points, order[corners]) if given is None or len(given) == len(points) else (points[order], corners)
    )
    made = []
    for index, subset in enumerate(subsets):
        used, mine = np.unique(faces[part == index], return_inverse=True)
        if len(used):
            normals = None if given is None else given[used]
            made.append(Part(subset, vertices[used], mine.reshape(-1, 3).astype(np.int64), normals))
    return made, len(crossing)


def _subsets(prim: Any, count: int, time: Any, where: str) -> tuple[IntArray, list[Any]]:
    """Which subset each face is in [count], and the subsets with materials, the first of them None."""
    found, subset_of = [None], np.zeros(count, np.int64)
    for child in children_of(prim):
        if not child.IsA(UsdGeom.Subset):
            continue
        subset = UsdGeom.Subset(child)
        bound = UsdShade.MaterialBindingAPI(child).GetDirectBinding().GetMaterial()
        if str(subset.GetElementTypeAttr().Get()) != "face" or not bound:
            continue
        indices = np.asarray(subset.GetIndicesAttr().Get(time) or (), np.int64)
        if len(indices) and (indices.min() < 0 or indices.max() >= count):
            raise InputError(f"{where}: its subset {shown(child.GetName())} names faces that there are not")
        subset_of[indices] = len(found)
        found.append(child)
    return subset_of, found


def children_of(prim: Any, abstract: bool = False) -> Iterator[Any]:
    """The prims below one, those of instances as well; ``abstract`` ones are those of prototypes."""
    predicate = Usd.PrimIsActive & Usd.PrimIsLoaded if abstract else Usd.PrimDefaultPredicate
    yield from prim.GetFilteredChildren(Usd.TraverseInstanceProxies(predicate))


def _normals(mesh: Any, points: int, corners: int, time: Any) -> Array | None:
    """Normals of the vertices or of the corners; None where the file has none that fit, or all are one a face."""
    values, kind = mesh.GetNormalsAttr().Get(time), str(mesh.GetNormalsInterpolation())
    primvar = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("normals")
    if primvar and primvar.HasValue():  # goes before the attribute
        values, kind = primvar.ComputeFlattened(time), str(primvar.GetInterpolation())
    array: Array = np.asarray(values if values is not None else (), np.float64).reshape(-1, 3)
    wanted = {"vertex": points, "varying": points, "faceVarying": corners}.get(kind)
    return array if wanted == len(array) and np.isfinite(array).all() else None


def look_of(prim: Any, where: str, time: Any) -> Look | None:
    """What the material that is bound to a prim or subset says; None without one.

    Raises:
        InputError: it shines by a picture, or a number is none to compute with.
    """
    bindings = UsdShade.MaterialBindingAPI(prim)
    material = next((m for purpose in ("full", "preview") if (m := bindings.ComputeBoundMaterial(purpose)[0])), None)
    if material is None:
        return None
    name = str(material.GetPrim().GetName())
    shader = next((s for x in _CONTEXTS if (s := material.ComputeSurfaceSource(x)[0])), None)
    if shader is None:
        return Look(name, None, False, None)
    kind = str(shader.GetIdAttr().Get() or shader.GetPrim().GetTypeName())
    if kind != PREVIEW and not shader.GetInput("emissiveColor"):
        glows = [x for x in shader.GetInputs() if "emi" in x.GetBaseName().lower() and np.any(_value(x, time)[0])]
        return Look(name, None, False, kind if glows else None)
    glow = shader.GetInput("emissiveColor")
    value, picture = _value(glow, time) if glow else (None, False)
    if picture:
        raise InputError(f"{where} shines by a picture, which is not read from USD; export glTF instead")
    radiance = np.asarray((0, 0, 0) if value is None else value, np.float32).reshape(3)
    within(radiance, f"{where}: its emissiveColor", 0.0, RADIANCE)
    metal = shader.GetInput("metallic")
    metalness = _value(metal, time)[0] if metal else None
    specular = shader.GetInput("useSpecularWorkflow")
    is_metal = isinstance(metalness, float) and metalness >= 0.5 and not (specular and _value(specular, time)[0])
    return Look(name, radiance if radiance.any() else None, is_metal, None)


def _value(given: Any, time: Any) -> tuple[Any, bool]:
    """The constant of an input, one of the material's interface as well, and whether it is a picture instead."""
    attributes = UsdShade.Utils.GetValueProducingAttributes(given)
    if not attributes:
        return None, False
    if UsdShade.Utils.GetType(attributes[0].GetName()) == UsdShade.AttributeType.Output:
        return None, True
    return attributes[0].Get(time), False
