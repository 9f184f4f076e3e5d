"""Area emitters of ``scene.xml`` that shine by a picture."""

import numpy as np
import OpenEXR
import pytest

from neurad.formats.mitsuba.read import read_xml
from neurad.images.image_io import write_exr, write_png
from neurad.images.picture_notes import say_pictures

mi = pytest.importorskip("mitsuba")

FLOOR = '<shape type="rectangle" id="floor"><transform name="to_world"><translate z="-2"/></transform></shape>'
TURN = '<transform name="to_uv"><rotate z="1" angle="90"/><scale x="0.5" y="1.5"/><translate x="0.2"/></transform>'


def write(folder, texture, shape="rectangle"):
    """A room with a lamp of this radiance."""
    lamp = f'<emitter type="area">{texture}</emitter>'
    (folder / "scene.xml").write_text(
        f'<scene version="3.0.0">{FLOOR}<shape type="{shape}" id="lamp">{lamp}</shape></scene>'
    )
    return folder / "scene.xml"


def bitmap(file, more=""):
    return f'<texture type="bitmap" name="radiance"><string name="filename" value="{file}"/>{more}</texture>'


def radiance_at(meshes, points):
    """What the triangles at points of the plane z = 0 emit [n, 3]."""
    found = np.full((len(points), 3), np.nan)
    for mesh in meshes:
        a, b, c = np.moveaxis(mesh.vertices[mesh.faces].astype(np.float64)[..., :2], 1, 0)
        inverse = np.linalg.inv(np.stack((b - a, c - a), -1))
        uv = np.einsum("fij,fnj->fni", inverse, points[None] - a[:, None])
        inside = ((uv > -1e-6).all(-1) & (uv.sum(-1) < 1 + 1e-6)).any(0)
        found[inside] = 0.0 if mesh.radiance is None else mesh.radiance
    return found


@pytest.mark.parametrize("more", ["", TURN])
def test_it_shines_as_mitsubas(tmp_path, more):
    rng = np.random.default_rng(0)
    write_exr(tmp_path / "glow.exr", rng.uniform(0.0, 5.0, (4, 5, 3)).astype(np.float32), half=False)
    path = write(tmp_path, bitmap("glow.exr", '<boolean name="raw" value="true"/>' + more))
    scene = read_xml(path).check()
    lit = [mesh for mesh in scene.meshes if mesh.name.startswith("lamp")]
    assert len(lit) > 10
    assert "shape lamp shines by a picture" in scene.notes[0]
    points = np.stack(np.meshgrid(*[(np.arange(60) + 0.5) / 30 - 1] * 2), -1).reshape(-1, 2)
    ours = radiance_at(lit, points)
    mi.set_variant("scalar_rgb")
    theirs = mi.load_file(str(path))
    seen = np.empty_like(ours)
    for i, (x, y) in enumerate(points):
        hit = theirs.ray_intersect(mi.Ray3f([float(x), float(y), 1.0], [0.0, 0.0, -1.0]))
        seen[i] = np.array(hit.emitter(theirs).eval(hit))
    assert np.isfinite(ours).all()
    parts = (points > 0) @ (1, 2)
    for part in range(4):  # each quarter, so that a picture that lies otherwise is found
        mine = parts == part
        assert np.allclose(ours[mine].mean(0), seen[mine].mean(0), rtol=0.02)
    assert np.abs(ours - seen).mean() < 0.1 * seen.mean()  # each piece has the mean of its texels


def test_pictures_of_codes_are_decoded(tmp_path):
    write_png(tmp_path / "glow.png", np.full((2, 2, 3), 188, np.uint8))
    lamp = read_xml(write(tmp_path, bitmap("glow.png"))).check().meshes[1]
    assert np.allclose(lamp.radiance, 0.503, atol=2e-3)
    assert len(lamp.faces) == 2  # one colour: nothing is cut


@pytest.mark.parametrize("raw", ["false", "true"])
def test_skies_and_textures_of_other_primaries_are_converted(tmp_path, capsys, raw):
    """Of Rec.2020, by the numbers of its standard; tiny negatives of a sky are 0."""
    half = np.full((4, 8, 3), 0.5, np.float32)
    half[1, 2] = 0.2, 0.7, 0.3
    sky = np.concatenate((half, np.full((4, 8, 1), 1.0, np.float32)), -1)
    sky[3, 3, :3] = -1e-7
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    header["chromaticities"] = (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290)
    for name, pixels in (("sky.exr", sky), ("base_color.exr", half), ("roughness.exr", half)):
        OpenEXR.File(header, {"RGBA"[: pixels.shape[2]]: pixels}).write(str(tmp_path / name))
    textures = "".join(
        f'<texture type="bitmap" name="{key}"><string name="filename" value="{key}.exr"/>'
        f'<boolean name="raw" value="{value}"/></texture>'
        for key, value in (("base_color", raw), ("roughness", "true"))
    )
    bsdf = f'<bsdf type="twosided"><bsdf type="principled">{textures}</bsdf></bsdf>'
    (tmp_path / "scene.xml").write_text(
        '<scene version="3.0.0"><emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>'
        f'<shape type="rectangle" id="floor">{bsdf}</shape></scene>'
    )
    scene = read_xml(tmp_path / "scene.xml").check()
    say_pictures()
    said = capsys.readouterr().err
    want = [0.2 * 1.660491 - 0.7 * 0.587641 - 0.3 * 0.07285, -0.2 * 0.12455 + 0.7 * 1.1329 - 0.3 * 0.008349,
            -0.2 * 0.018151 - 0.7 * 0.100579 + 0.3 * 1.11873]  # fmt: skip
    want = np.maximum(want, 0.0)
    texture = scene.materials[scene.meshes[0].material].albedo
    assert np.allclose(texture.pixels[1, 2], want, atol=1e-4)
    assert np.allclose(scene.environment.pixels[1, 2], want, atol=1e-4)
    assert np.allclose(scene.environment.pixels[0, 0], 0.5, atol=1e-4)
    assert scene.environment.pixels.min() == 0.0
    assert "primaries of Rec.2020 are converted" in said
    assert "sky.exr: 1 pixels are negative" in said
