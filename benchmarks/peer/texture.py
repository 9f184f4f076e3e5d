"""The position-driven Mitsuba texture through which path replay reads and differentiates voxel values."""

from typing import Any

import numpy as np

from benchmarks.peer.voxels import SurfaceVoxels
from neurad.core.scene_records import Material

NAME = "neurad_voxels"


def make_texture(mi: Any, voxels: SurfaceVoxels) -> Any:
    """A texture with albedo as its colour and roughness as its scalar, trilinear in ``voxels`` at ``si.p``.

    Its attribute ``values`` holds albedo and roughness of every vertex in a row [n * 4]; it can be replaced at any
    time and take gradients.
    """
    import drjit as dr

    stride = voxels.resolution + 1

    class Voxels(mi.Texture):  # type: ignore[misc]
        """Eight gathers of four values each."""

        def __init__(self, props: Any) -> None:
            mi.Texture.__init__(self, props)
            self.values = mi.Float(np.full(4 * len(voxels), 0.5, np.float32))
            self.entry = mi.UInt32(voxels.entry)
            self.low = mi.Point3f(*(float(x) for x in voxels.low))
            self.scale = mi.Float(voxels.resolution / voxels.side)
            dr.make_opaque(self.low, self.scale)

        def _lookup(self, si: Any, active: Any) -> Any:
            x = dr.clip((si.p - self.low) * self.scale, 0.0, float(voxels.resolution))
            cell = [dr.minimum(mi.UInt32(x[axis]), voxels.resolution - 1) for axis in range(3)]
            f = [x[axis] - mi.Float(cell[axis]) for axis in range(3)]
            base = cell[0] + stride * (cell[1] + stride * cell[2])
            out = dr.zeros(mi.Vector4f)
            for k, offset in enumerate(voxels.corners()):
                w = mi.Float(1.0)
                for axis in range(3):
                    w *= f[axis] if k >> axis & 1 else 1.0 - f[axis]
                index = dr.gather(mi.UInt32, self.entry, base + offset, active)
                out = dr.fma(w, dr.gather(mi.Vector4f, self.values, index, active), out)
            return out

        def eval(self, si: Any, active: Any = True) -> Any:
            value = self._lookup(si, active)
            return mi.Color3f(value.x, value.y, value.z)

        def eval_1(self, si: Any, active: Any = True) -> Any:
            return self._lookup(si, active).w

        def eval_3(self, si: Any, active: Any = True) -> Any:
            return self.eval(si, active)

        def mean(self) -> Any:
            return mi.Float(0.5)

        def is_spatially_varying(self) -> bool:
            return True

        def traverse(self, callback: Any) -> None:
            callback.put("values", self.values, mi.ParamFlags.Differentiable)

        def to_string(self) -> str:
            return f"{NAME}[{len(voxels)} vertices]"

    mi.register_texture(NAME, Voxels)
    return mi.load_dict({"type": NAME})


def make_shading(mi: Any, texture: Any, diffuse: bool) -> Any:
    """A function from a material to the Mitsuba BSDF that reads ``texture`` in its place.

    One BSDF stands for all two-sided materials and one for the others, so that virtual calls do not diverge.
    """
    inner = (
        {"type": "diffuse", "reflectance": texture}
        if diffuse
        else {"type": "principled", "base_color": texture, "roughness": texture, "eta": 1.5}
    )
    made: dict[bool, Any] = {}

    def shading(material: Material) -> Any:
        if material.two_sided not in made:
            described = {"type": "twosided", "bsdf": inner} if material.two_sided else inner
            made[material.two_sided] = mi.load_dict(described)
        return made[material.two_sided]

    return shading
