"""A room that many programs read, exported once."""

import pytest
from helpers.clients import Validator, cache_folder
from helpers.exported import exported

from neurad.scene.builtin import build


@pytest.fixture(scope="session")
def kitchen():
    """The built-in patterned kitchen."""
    return build("patterns")


@pytest.fixture(scope="session")
def kitchen_room(kitchen, tmp_path_factory):
    """A folder with the built-in patterned kitchen, textures of 16 x 16."""
    pytest.importorskip("xatlas")
    return exported(kitchen, tmp_path_factory.mktemp("export") / "küche 1")


@pytest.fixture(scope="session")
def validator(request):
    """Khronos' glTF validator."""
    made = Validator(cache_folder(request, "gltf-validator"))
    yield made
    made.close()
