"""Changes of one thing in a scene folder, each a function of the folder: what tables of refusals are made of."""

import numpy as np

from helpers.tiny_scene import SIZE, read_json, write_json
from neurad.images.image_io import write_exr


def nothing(folder):
    """Leave all as it is."""


def replaced(name, old, new, count=1):
    """Put another text in place of one that a file has."""

    def spoil(folder):
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new, count))

    return spoil


def xml(old, new):
    return replaced("scene.xml", old, new)


def removed(name):
    return lambda folder: (folder / name).unlink()


def written(name, data):
    def spoil(folder):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data if isinstance(data, bytes) else data.encode())

    return spoil


def cut(name, size):
    """Leave the first bytes of a file; of a negative number, all but the last ones."""
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:size])


def both(*changes):
    return lambda folder: [change(folder) for change in changes]


def top(**changes):
    """Change keys of a camera file; one that is ``...`` is taken away."""

    def spoil(folder):
        described = {**read_json(folder, "train"), **changes}
        write_json(folder, "train", {k: v for k, v in described.items() if v is not ...})

    return spoil


def frame(part="train", **changes):
    """Change keys of the second frame of a camera file; one that is ``...`` is taken away."""

    def spoil(folder):
        described = read_json(folder, part)
        changed = {**described["frames"][1], **changes}
        described["frames"][1] = {k: v for k, v in changed.items() if v is not ...}
        write_json(folder, part, described)

    return spoil


def photograph(value=1.0, name="train_1", height=SIZE, channels=3):
    """Write a photograph of ones with one odd value in its last channel."""

    def spoil(folder):
        pixels = np.ones((height, SIZE, channels), np.float32)
        pixels[3, 4, -1] = value
        write_exr(folder / f"images/{name}.exr", pixels, half=False)

    return spoil


def photographs(value, channels=3):
    """Write all training photographs, the last channel of this value, the others of 0.5."""

    def spoil(folder):
        pixels = np.full((SIZE, SIZE, channels), 0.5, np.float32)
        pixels[..., -1 if channels > 3 else slice(None)] = value
        for i in range(3):
            write_exr(folder / f"images/train_{i}.exr", pixels, half=False)

    return spoil


# ---- the floor's BSDF of tiny_scene


PNG = '<texture type="bitmap" name="{}"><string name="filename" value="textures/paint.png"/></texture>'


def set_paint(parameter):
    return xml("</bsdf></bsdf>", parameter + "</bsdf></bsdf>")


def inside(plugin):
    """Put the floor's BSDF into another one."""
    opened = f'<bsdf type="{plugin}"><bsdf type="principled">'
    return both(xml('<bsdf type="principled">', opened), xml("</bsdf></bsdf>", "</bsdf></bsdf></bsdf>"))


def beside(bsdf):
    """Put another BSDF beside the floor's inside the two-sided one."""
    return xml('<bsdf type="principled">', f'{bsdf}<bsdf type="principled">')


def as_floor(bsdf):
    return xml('<ref id="paint"/>', bsdf)
