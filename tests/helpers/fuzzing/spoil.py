"""Every mutation of a scene folder by name, and a scene folder from a recipe."""

from pathlib import Path

from helpers.fuzzing.seeds import VARIANTS, seed_files
from helpers.fuzzing.spoil_bytes import GENERAL, write_files
from helpers.fuzzing.spoil_images import IMAGES
from helpers.fuzzing.spoil_json import JSON
from helpers.fuzzing.spoil_meshes import MESHES
from helpers.fuzzing.spoil_xml import XML

MUTATIONS = {**GENERAL, **XML, **JSON, **MESHES, **IMAGES}
GROUPS = (
    [*XML, *["xml_number"] * 5, "xml_insert", "xml_insert", "xml_change"],
    [*MESHES, "ply_body"],
    [*IMAGES, "exr_pixels"],
    list(JSON),
    list(GENERAL),
)
"""Their names, those of one kind of file together; some of them more often than others."""


def write_spoilt(folder: Path, variant: int, mutations: list[list]) -> None:
    """Write the scene folder of a recipe.

    Args:
        folder: where; its parent exists.
        variant: of the correct folder to start from.
        mutations: name and three numbers of each.
    """
    files = dict(seed_files(variant % VARIANTS))
    for name, i, j, k in mutations:
        MUTATIONS[name](files, i, j, k)
    folder.mkdir()
    write_files(files, folder)
