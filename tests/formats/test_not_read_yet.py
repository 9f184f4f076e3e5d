"""What cannot be read gets a sentence that says what to do."""

import json

import pytest

from neurad.core.errors import InputError
from neurad.formats.cameras.nerf import read_views
from neurad.formats.load import load_scene
from neurad.formats.meshes.files import read_meshes


@pytest.mark.parametrize(
    ("ending", "said"), [(".arw", "merge it with `neurad data hdr`"), (".webp", "save it in one of these formats")]
)
def test_photographs_of_other_formats(tmp_path, ending, said):
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / f"000{ending}").write_bytes(b"x")
    cameras = tmp_path / "transforms_train.json"
    frame = {"file_path": f"images/000{ending}", "transform_matrix": []}
    cameras.write_text(json.dumps({"camera_angle_x": 1.0, "frames": [frame]}))
    with pytest.raises(InputError, match=rf"000\{ending}: .*none of \.exr, \.hdr.*{said}"):
        read_views(cameras, tmp_path)


def test_a_scene_of_another_program(tmp_path):
    sentences = {
        "room.glb": "`neurad data gltf room.glb --out DIR` makes",
        "room.blend": "`neurad data blender room.blend --out DIR` makes",
    }
    for name, sentence in sentences.items():
        folder = tmp_path / name[5:]
        folder.mkdir()
        file = folder / name
        file.write_bytes(b"x")
        with pytest.raises(InputError, match=rf"{name}: .*{sentence}"):
            load_scene(str(file), None)
        with pytest.raises(InputError, match=rf"scene\.xml: the scene folder lacks this file .*; {name}: .*{sentence}"):
            load_scene(str(folder), None)
    with pytest.raises(InputError, match=r"room\.blend: it is no mesh that can be read; export it as one of \.obj"):
        read_meshes(file)


def test_a_name_that_was_nearly_right(tmp_path):
    (tmp_path / "scene.xlm").write_text("")
    with pytest.raises(InputError, match=r"lacks this file \(or scene\.glb, scene\.gltf\), did you mean scene\.xlm\?"):
        load_scene(str(tmp_path), None)
    (tmp_path / "kitchen").mkdir()
    with pytest.raises(InputError, match=r"there is no folder .*kichen, did you mean kitchen\?"):
        load_scene(str(tmp_path / "kichen"), None)


def test_a_neighbour_in_a_series_is_not_suggested(tmp_path):
    (tmp_path / "001.exr").write_bytes(b"x")
    (tmp_path / "room.obj").write_bytes(b"x")
    with pytest.raises(InputError) as said:
        read_meshes(tmp_path / "002.exr")
    assert "did you mean" not in str(said.value)
    with pytest.raises(InputError, match=r"rom\.obj: there is no such mesh file, did you mean room\.obj\?"):
        read_meshes(tmp_path / "rom.obj")
