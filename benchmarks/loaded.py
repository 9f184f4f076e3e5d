"""Mitsuba 3 with the just-in-time compiler for CPUs, and a scene as it loads it without a file."""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from neurad.core.errors import InputError
from neurad.core.scene_records import Material, View
from neurad.formats.mitsuba.plugin import COMPILED, LLVM, no_llvm, sensor
from neurad.formats.mitsuba.write import ORIGIN, Matrix, Node, describe, file_names
from neurad.runtime.extras import needed
from neurad.scene.description import Scene

HOW = f"apt-get install libllvm19, or set DRJIT_LIBLLVM_PATH to a libLLVM.so of version {LLVM[0]} or newer"


def load_mitsuba(program: str = "bench peer") -> Any:
    """The module ``mitsuba`` with the variant ``llvm_ad_rgb`` set and one thread a usable core.

    Args:
        program: that wants it, for the sentence.

    Raises:
        InputError: the package or a fitting LLVM library is missing.
    """
    with needed("mitsuba", "mitsuba", f"{program}: it"):
        import mitsuba as mi
    try:
        mi.set_variant(COMPILED)
        reason = no_llvm()
    except (ImportError, AttributeError) as error:
        reason = " ".join(str(error).split()).rstrip(".")
    if reason is not None:
        raise InputError(f"{program}: Mitsuba's {COMPILED} does not start ({reason}): {HOW}")
    return mi


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
