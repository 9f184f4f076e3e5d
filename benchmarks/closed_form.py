"""Light of closed diffuse rooms in closed form."""

from neurad.scene.geometry import Geometry


def emitted(geometry: Geometry) -> float:
    """Radiance of the red channel that surfaces send out by themselves, in the mean over their area."""
    area = geometry.face_area.double()
    return float((area * geometry.emission[:, 0].double()).sum() / area.sum())


def reflected_radiance(geometry: Geometry, albedo: float) -> float:
    """Mean reflected light of a closed room of one albedo: ``E rho / (1 - rho)`` with :func:`emitted` ``E``."""
    return emitted(geometry) * albedo / (1.0 - albedo)
