"""The triangles of a scene on tensors: surface points at hits, and rays that leave them."""

from functools import cached_property

import numpy as np
import torch
from torch import Tensor, nn

from neurad.core.errors import InputError
from neurad.core.extent import subsample, typical_extent
from neurad.core.frame import dot
from neurad.core.records import Float64Array, Hit, IntArray, Rays, SurfaceInteraction
from neurad.core.scene_records import Mesh
from neurad.runtime.dispatch import use_kernel
from neurad.runtime.threads import GRAIN, split
from neurad.scene.connected import connected_parts
from neurad.scene.description import Scene
from neurad.scene.triangles import NearestTriangles, merged, normals_and_areas

EPS = 2.0**-23  # spacing of float32 at 1
CHUNK = 32768  # lanes that the CPU works on at once: their temporaries stay in the cache (2.4 times faster at 262144)
SHADOW_MARGIN = 1e-4  # shadow rays stop this fraction of their length before the light; see Geometry.spawn_towards


class Geometry(nn.Module):
    """All meshes of a scene, merged. The buffers are not part of checkpoints: the scene file holds them.

    Attributes:
        vertices: [V, 3].
        faces: indices into ``vertices`` [F, 3], int64.
        face_normal: unit geometric normals [F, 3]; +Z for triangles without area, which no ray hits.
        face_area: [F].
        material: index into ``Scene.materials`` [F], int64.
        emission: emitted radiance to the side of the geometric normal [F, 3]; 0 where there is none.
        mesh_index: index into ``Scene.meshes`` [F], int64.
        face_offset: how far a spawned ray must start from the triangle [F], see :meth:`spawn`.
        scale: radius of the bounding sphere in scene units, without triangles that lie a thousand times farther out
            than others.
    """

    vertices: Tensor
    faces: Tensor
    face_normal: Tensor
    face_area: Tensor
    material: Tensor
    emission: Tensor
    mesh_index: Tensor
    face_offset: Tensor
    table: Tensor

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        meshes = scene.meshes
        count = [len(mesh.faces) for mesh in meshes]
        vertices, faces, _ = merged(meshes)
        p = vertices.astype(np.float32).astype(np.float64)[faces]  # [F, 3 corners, 3]
        normal, area = normals_and_areas(p)

        self._add("vertices", vertices, torch.float32)
        self._add("faces", faces, torch.int64)
        self._add("face_normal", normal, torch.float32)
        self._add("face_area", area, torch.float32)
        mesh_index = np.repeat(np.arange(len(meshes)), count)
        self._add("mesh_index", mesh_index, torch.int64)
        self._add("material", np.repeat([mesh.material for mesh in meshes], count), torch.int64)
        self._add("emission", np.repeat(scene.radiance, count, axis=0), torch.float32)

        low, high = (p.min((0, 1)), p.max((0, 1))) if len(p) else (np.zeros(3), np.zeros(3))
        self.scale = typical_extent(0.5 * float(np.linalg.norm(high - low)), _distances(p))
        self._add("face_offset", _offsets(p, normal), torch.float32)
        corners = np.concatenate((p, _corner_normals(meshes, normal), _corner_uvs(meshes)), -1)  # [F, 3, 8]
        # value = base + (u du + v dv): one gather brings everything that an interaction needs.
        base, du, dv = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        self._add("table", np.concatenate((base, du, dv, normal, np.zeros((len(p), 5))), -1), torch.float32)  # [F, 32]
        self._attributes = self._add_attributes(meshes)

    def _add(self, name: str, values: np.ndarray, dtype: torch.dtype) -> None:
        self.register_buffer(name, torch.as_tensor(np.ascontiguousarray(values)).to(dtype), persistent=False)

    def _add_attributes(self, meshes: list[Mesh]) -> dict[str, str]:
        """Register the vertex attributes; returns the buffer's name for each (attributes may have any name)."""
        buffers: dict[str, str] = {}
        for name in sorted({name for mesh in meshes for name in mesh.attributes}):
            channels = {mesh.attributes[name].shape[1] for mesh in meshes if name in mesh.attributes}
            if len(channels) > 1:
                raise InputError(f"vertex attribute {name}: its meshes disagree on the number of channels")
            blank = channels.pop()
            parts = [m.attributes.get(name, np.zeros((len(m.vertices), blank))) for m in meshes]
            buffers[name] = f"attribute_{len(buffers)}"
            self._add(buffers[name], np.concatenate(parts), torch.float32)
        return buffers

    @cached_property
    def connected(self) -> IntArray:
        """Connected part of each triangle [F], see :func:`neurad.scene.connected.connected_parts`."""
        return connected_parts(self.vertices.cpu().numpy(), self.faces.cpu().numpy())

    def nearest(self, p: Tensor) -> Tensor:
        """Triangle nearest to each position [n, 3], see :class:`neurad.scene.triangles.NearestTriangles`."""
        return torch.from_numpy(self._nearest(p.detach().cpu().numpy())).to(p.device)

    @cached_property
    def _nearest(self) -> NearestTriangles:
        return NearestTriangles(*(x.cpu().numpy() for x in (self.vertices, self.faces, self.face_area)))

    def interact(self, rays: Rays, hit: Hit) -> SurfaceInteraction:
        """The surface points [n] that rays ended at. Misses keep ``wo = -d``, prim -1, and a finite position."""
        return self.interact_at(hit.prim, hit.u, hit.v, -rays.d, hit.valid)

    def interact_at(self, prim: Tensor, u: Tensor, v: Tensor, wo: Tensor, valid: Tensor) -> SurfaceInteraction:
        """Surface points from triangles and barycentrics.

        The position comes from the barycentrics, not from origin and distance: its error is then some units in the last
        place of the coordinates, however long the ray was. Without texture coordinates the barycentrics serve as such,
        as in Mitsuba.

        Args:
            prim: triangle [n], int64; anything below 0 where ``valid`` is False.
            u: first barycentric [n].
            v: second barycentric [n].
            wo: unit directions towards the viewer [n, 3].
            valid: whether there is a surface [n], bool.
        """
        if use_kernel(len(self.faces) > 0, self.table, u, wo):
            return self._interact_kernel(prim, u, v, wo, valid)
        return self.interact_reference(prim, u, v, wo, valid)

    def _interact_kernel(self, prim: Tensor, u: Tensor, v: Tensor, wo: Tensor, valid: Tensor) -> SurfaceInteraction:
        from neurad.scene import geometry_kernels as kernels  # imported at first use: numba is slow to load

        p, ng, n = torch.empty(3, len(prim), 3).unbind()
        uv, bary = torch.empty(2, len(prim), 2).unbind()
        given = (x.contiguous().numpy() for x in (prim, u, v.detach(), self.table))
        arrays = *given, *(x.numpy() for x in (p, ng, n, uv, bary))
        split(lambda low, high: kernels.interact(low, high, *arrays), len(prim), GRAIN)
        return SurfaceInteraction(p, ng, n, wo, uv, bary, prim, valid)

    def interact_reference(self, prim: Tensor, u: Tensor, v: Tensor, wo: Tensor, valid: Tensor) -> SurfaceInteraction:
        """:meth:`interact_at` in plain torch, on any device."""
        if len(prim) > CHUNK and prim.device.type == "cpu":
            cuts = (slice(i, i + CHUNK) for i in range(0, len(prim), CHUNK))
            return SurfaceInteraction.cat(
                *(self.interact_reference(prim[c], u[c], v[c], wo[c], valid[c]) for c in cuts)
            )
        bary = torch.stack((u, v), -1)
        if len(self.faces) == 0:
            zero, up = torch.zeros_like(wo), torch.zeros_like(wo)
            up[:, 2] = 1.0
            return SurfaceInteraction(zero, up, up, wo, torch.zeros_like(bary), bary, prim, valid)
        row = self.table.index_select(0, prim.clamp_min(0))
        value = row[:, :8] + torch.addcmul(u[:, None] * row[:, 8:16], v[:, None], row[:, 16:24])
        ng = row[:, 24:27]
        # The multiple of ng decides where opposite vertex normals cancel out; elsewhere it is below its precision.
        n = torch.add(value[:, 3:6], ng, alpha=1e-12)
        n = n / torch.linalg.vector_norm(n, dim=-1, keepdim=True)
        p, uv = value[:, :3].contiguous(), value[:, 6:].contiguous()
        return SurfaceInteraction(p, ng.contiguous(), n, wo, uv, bary, prim, valid)

    def material_at(self, si: SurfaceInteraction) -> Tensor:
        """Index into ``Scene.materials`` at the lanes of ``si`` [n], int64; some material where there is no surface."""
        return self.material[si.prim.clamp_min(0)]

    def attribute(self, name: str, si: SurfaceInteraction) -> Tensor:
        """The vertex attribute ``name`` interpolated at ``si`` [n, channels]; 0 on meshes that lack it and at misses.

        Raises:
            InputError: no mesh has the attribute.
        """
        if name not in self._attributes:
            known = ", ".join(self._attributes) or "none"
            raise InputError(f"vertex attribute {name}: no mesh has it (there are: {known})")
        values: Tensor = getattr(self, self._attributes[name])
        if len(self.faces) == 0:
            return values.new_zeros(len(si), values.shape[1])
        u, v = si.bary.unbind(-1)
        weight = torch.stack((1.0 - u - v, u, v), -1) * si.valid[:, None]
        corner = values[self.faces.index_select(0, si.prim.clamp_min(0))]  # [n, 3, c]
        return (weight[..., None] * corner).sum(1)

    def _origins(self, si: SurfaceInteraction, wi: Tensor) -> tuple[Tensor, Tensor]:
        """Origins [n, 3] off the surface on the side of ``wi``, and how far off they are [n]."""
        if len(self.faces) == 0:
            return si.p, torch.zeros_like(si.p[:, 0])
        near = EPS * si.p.abs().amax(-1).clamp_min(self.scale / 1024)
        offset = self.face_offset.index_select(0, si.prim.clamp_min(0)) + near
        side = torch.copysign(offset, dot(wi, si.ng))
        return torch.addcmul(si.p, side[:, None], si.ng), offset

    def spawn(self, si: SurfaceInteraction, wi: Tensor) -> Rays:
        """Rays from ``si`` in directions ``wi`` [n, 3] that do not hit the surface they leave.

        The tracers accept any t > 0, so the origin moves along the geometric normal to the side of ``wi``, by two
        parts:

        * ``face_offset`` bounds the error across the triangle's plane. With u = 2^-24, rounding ``p0 + (a e1 + b e2)``
          and then the moved origin costs ``u |n| . (2 |p| + 3 (|e1| + |e2|))``, and the tracer's own ``p0 - o`` and
          plane test about ``4 u |n| . (|e1| + |e2|)``. Weighting by the normal makes it small where it can be: the
          floor ``y = 0`` is represented exactly, however large it is, and small objects on it stay visible.
        * ``2^-23 |p|`` in the largest coordinate, for neighbours with another plane when rounding puts a point just
          across their common edge. The floor of 1/1024 of the scene's radius only matters close to the origin.

        Everything is proportional to the coordinates: a scene scaled by any factor gives the same picture.
        """
        return Rays(self._origins(si, wi)[0], wi)

    def spawn_towards(self, si: SurfaceInteraction, wi: Tensor, distance: Tensor) -> tuple[Rays, Tensor]:
        """Shadow rays from ``si`` towards a light ``distance`` [n] away along ``wi`` [n, 3] (infinity allowed).

        The ray is aimed anew from its moved origin, so that it ends at the sampled point. It ends short of it by twice
        the offset plus :data:`SHADOW_MARGIN` of its length: the light's own triangle, known to within the offset, then
        does not occlude unless it is seen at a cosine below about 1e-3, where it emits next to nothing towards it.

        Returns:
            The rays, and for each the distance ``t_max`` [n] below which a hit means shadow.
        """
        o, offset = self._origins(si, wi)
        finite = torch.isfinite(distance)
        way = si.p - o + wi * torch.where(finite, distance, 1.0)[:, None]
        length = torch.linalg.vector_norm(way, dim=-1)
        aimed = way / length.clamp_min(torch.finfo(way.dtype).tiny)[:, None]
        t_max = (length * (1.0 - SHADOW_MARGIN) - 2.0 * offset).clamp_min(0.0)
        return Rays(o, torch.where(finite[:, None], aimed, wi)), torch.where(finite, t_max, distance)


def _distances(p: Float64Array) -> Float64Array:
    """Distances of some of the triangles [F, 3, 3] from their common middle."""
    center = p[subsample(len(p))].mean(1)
    return np.asarray(np.linalg.norm(center - np.median(center, 0), axis=-1)) if len(p) else np.zeros(0, np.float32)


def _offsets(p: Float64Array, normal: Float64Array) -> Float64Array:
    """Bound of the error across the plane of triangles [F, 3, 3]: [F]; derived at :meth:`Geometry.spawn`."""
    edges = np.abs(p[:, 1] - p[:, 0]) + np.abs(p[:, 2] - p[:, 0])
    offsets: Float64Array = EPS * (np.abs(normal) * (np.abs(p).max(1) + 4.0 * edges)).sum(-1)
    return offsets


def _corner_normals(meshes: list[Mesh], normal: Float64Array) -> Float64Array:
    """Normals at the corners [F, 3, 3]; the geometric one for flat meshes and where a file has a zero normal."""
    corner = np.repeat(normal[:, None], 3, axis=1)
    start = 0
    for mesh in meshes:
        part = corner[start : start + len(mesh.faces)]
        if mesh.normals is not None:
            given = mesh.normals[mesh.faces].astype(np.float64)
            length = np.linalg.norm(given, axis=-1, keepdims=True)
            part[:] = np.where(length > 0, given / np.where(length > 0, length, 1.0), part)
        start += len(mesh.faces)
    return corner


def _corner_uvs(meshes: list[Mesh]) -> Float64Array:
    """Texture coordinates at the corners [F, 3, 2]; those of the barycentrics for meshes without."""
    bary = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    parts = [np.tile(bary, (len(m.faces), 1, 1)) if m.uvs is None else m.uvs[m.faces] for m in meshes]
    return np.concatenate([np.zeros((0, 3, 2)), *parts])
