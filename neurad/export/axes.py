"""The one rotation that turns what points up in a room to where a format wants it."""

from typing import Literal, cast

from scipy.spatial.transform import Rotation

from neurad.core.records import Array
from neurad.formats.axes import most_up, turned
from neurad.scene.description import Scene

Up = Literal["x", "y", "z", "-x", "-y", "-z"]


def up_axis(scene: Scene) -> Up:
    """The axis that the cameras of a scene hold up on average; ``y`` without cameras."""
    views = (*scene.train, *scene.test)
    return cast(Up, most_up(views)[0]) if views else "y"


def rotation(up: Up) -> Array:
    """The matrix [3, 3] that turns an up axis to +Y."""
    return turned(up, "y", 1.0)[:3, :3]


def quaternion(matrix: Array) -> list[float]:
    """A rotation matrix [3, 3] as a unit quaternion (x, y, z, w)."""
    return [float(x) for x in Rotation.from_matrix(matrix).as_quat()]
