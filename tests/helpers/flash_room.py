"""The Cornell box photographed with a flash: cameras anywhere in it, each with a light of its own."""

import json
from dataclasses import replace

import numpy as np

from benchmarks.stress.folder import photograph
from neurad.core.camera import flash_in_world
from neurad.core.scene_records import PunctualLight, View
from neurad.formats.cameras.write import transforms
from neurad.formats.mitsuba.write import describe, write_xml
from neurad.images.image_io import write_exr
from neurad.scene import builtin
from neurad.scene.builtin.shapes import look_at


def flash(intensity=(3.0, 2.8, 2.6), at=(0.05, 0.0, 0.0), kind="point", along=(0.0, 0.0, -1.0)):
    """A light in the space of a camera."""
    rgb, place, axis = (np.asarray(x, np.float32) for x in (intensity, at, along))
    return PunctualLight("flash", kind, rgb, place, axis, 40.0, 25.0)


def cameras(count, seed, size=64):
    """Cameras above the blocks that look through the middle of the room."""
    rng, found = np.random.default_rng(seed), []
    while len(found) < count:
        eye, target = rng.uniform(-0.9, 0.9, 3), rng.uniform(-0.6, 0.6, 3)
        clear = eye[1] >= 0.35 or np.abs(eye[[0, 2]]).max() >= 0.8
        if clear and np.linalg.norm(target - eye) >= 0.8:
            found.append(look_at(tuple(eye), tuple(target), 70.0, size))
    return found


def flash_room(light, lamp=False, views=20, size=64):
    """The room with ``light`` at every camera, and its ceiling ``lamp`` on or gone."""
    scene = builtin.build("cornell")
    meshes = [mesh for mesh in scene.meshes if lamp or mesh.radiance is None]
    train, test = (
        [View(f"{name}_{i:03d}", replace(camera, flash=light)) for i, camera in enumerate(cameras(count, seed, size))]
        for name, count, seed in (("train", views, 1), ("test", 4, 2))
    )
    return replace(scene, name="flash", meshes=meshes, train=train, test=test).check()


def lit_by(scene, *lights):
    """The scene without a flash, with other lights that stay where they are."""
    train, test = (
        [replace(view, camera=replace(view.camera, flash=None)) for view in views]
        for views in (scene.train, scene.test)
    )
    return replace(scene, punctual=lights, train=train, test=test).check()


def standing(scene, camera):
    """The scene in which the flash of a camera stays where it is."""
    return lit_by(scene, flash_in_world(camera))


def write_folder(scene, folder, spp, photographed=None):
    """A scene folder with photographs of ``spp`` samples and true maps; ``photographed`` is what they show, where that
    is not what the folder says."""
    folder.mkdir(parents=True)
    write_xml(describe(scene, folder), folder / "scene.xml")
    maps = [parameter.name for parameter in scene.parameters]
    for name, views in (("train", scene.train), ("test", scene.test)):
        (folder / f"transforms_{name}.json").write_text(json.dumps(transforms(views, maps=maps)))
    for kind, pictures in photograph(photographed or scene, spp).items():
        (folder / kind).mkdir()
        for name, pixels in pictures.items():
            write_exr(folder / kind / f"{name}.exr", pixels, half=False)
    return folder
