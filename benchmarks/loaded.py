"""A scene as Mitsuba 3 loads it without a file, for races and for comparisons of both renderers."""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from neurad.core.scene_records import Material, View
from neurad.formats.mitsuba.plugin import sensor
from neurad.formats.mitsuba.write import ORIGIN, Matrix, Node, describe, file_names
from neurad.scene.description import Scene


def to_mitsuba(
    scene: Scene,
    view: View,
    size: int,
    samples: int = 16,
    integrator: Node | None = None,
    shading: Callable[[Material], Any] | None = None,
) -> Any:
    """``scene`` seen by ``view`` at ``size`` x ``size`` pixels with a box filter. A variant must have been set.

    Args:
        scene: what to build.
        view: the only sensor.
        size: width and height of its film in pixels.
        samples: per pixel.
        integrator: defaults to ``path`` with the scene's ``max_depth`` and ``rr_depth``.
        shading: the Mitsuba BSDF that stands for a material that is not a delta one; None keeps the scene's own.
    """
    import mitsuba as mi

    with tempfile.TemporaryDirectory() as folder:
        camera = sensor(scene, view.camera, size, size, samples)
        tree = describe(scene, Path(folder), [camera], integrator, half=False)
        for material, name in zip(scene.materials, file_names([m.name for m in scene.materials]), strict=True):
            if shading is not None and not material.model.is_delta:
                _shade(tree, f"material-{name}", shading(material))
        return mi.load_dict(_loadable(mi, tree, Path(folder)))


def _shade(tree: Node, label: str, bsdf: Any) -> None:
    """Let the meshes of a material have another BSDF."""
    tree.pop(label, None)
    for node in tree.values():
        if isinstance(node, dict) and isinstance(node.get("bsdf"), dict) and node["bsdf"].get("id") == label:
            node["bsdf"] = bsdf


def _loadable(mi: Any, node: Any, folder: Path) -> Any:
    """A tree as ``mitsuba.load_dict`` takes it."""
    if isinstance(node, Matrix):
        square = np.asarray(node.values)
        return mi.ScalarTransform4f(square) if len(square) == 4 else mi.ScalarTransform3f(square)
    if not isinstance(node, dict):
        return node
    made = {key: _loadable(mi, value, folder) for key, value in node.items() if key not in ORIGIN}
    if "filename" in made:
        made["filename"] = str(folder / made["filename"])
    return made
