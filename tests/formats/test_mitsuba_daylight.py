"""Sun and sky, smooth plastic and Beckmann distributions of Mitsuba's scene files."""

import math

import numpy as np
import pytest
import torch

from neurad.bsdf.table import make_bsdf
from neurad.core.errors import InputError
from neurad.core.records import Surface
from neurad.core.reflection import RoughPlasticModel
from neurad.emitters.environment import Environment
from neurad.formats.mitsuba import lights as baking
from neurad.formats.mitsuba.lights import HEIGHT
from neurad.formats.mitsuba.materials import BECKMANN, PLASTIC_ALPHA
from neurad.formats.mitsuba.read import read_xml
from neurad.scene.description import Features

mi = pytest.importorskip("mitsuba")
TEXEL = math.pi / (HEIGHT - 1)
SHAPE = '<shape type="rectangle"/>'


def read(folder, more, version="3.0.0", shapes=SHAPE):
    file = folder / "scene.xml"
    file.write_text(f'<scene version="{version}">{more}{shapes}</scene>')
    return read_xml(file)


def daylight(kind, inside=""):
    return f'<emitter type="{kind}">{inside}</emitter>'


def values(emitter, directions):
    """Mitsuba's radiance from directions [n, 3]."""
    si, found = mi.SurfaceInteraction3f(), []
    for d in directions.tolist():
        si.wi = [-x for x in d]
        found.append(list(emitter.eval(si)))
    return np.array(found)


@pytest.fixture
def coarse(monkeypatch):
    """Maps of a quarter of the size, which take a moment."""
    monkeypatch.setattr(baking, "HEIGHT", 128)
    monkeypatch.setattr(baking, "WIDTH", 256)


def sun_of(environment):
    """Direction [3] and irradiance [3] of what shines like a sun in a map."""
    light = Environment(environment)
    pixels = np.where(environment.pixels > 30.0, environment.pixels, 0.0).astype(np.float64)  # no sky is so bright
    rows, columns = np.nonzero(pixels.sum(-1))
    step = math.pi / (len(pixels) - 1)
    theta, phi = step * rows, 2 * math.pi * (columns + 0.5) / pixels.shape[1]
    local = np.stack((np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)), -1)
    weight = (
        pixels[rows, columns] * (np.maximum(np.sin(theta), step / 6) * 2 * math.pi / pixels.shape[1] * step)[:, None]
    )
    towards = (local * weight.sum(-1)[:, None]).sum(0) @ light.rotation.numpy().T
    return towards / np.linalg.norm(towards), weight.sum(0)


FLAT = '<transform name="to_world"><rotate x="1" angle="-90"/><rotate y="1" angle="30"/></transform>'
PLACES = {
    "as it is": ("", {}, np.eye(4)),
    "given": (
        '<vector name="sun_direction" x="0.3" y="-0.5" z="0.9"/><float name="turbidity" value="6"/>'
        '<rgb name="albedo" value="0.2, 0.4, 0.6"/><float name="sun_aperture" value="2"/>',
        {"sun_direction": [0.3, -0.5, 0.9], "turbidity": 6.0, "sun_aperture": 2.0,
         "albedo": {"type": "rgb", "value": [0.2, 0.4, 0.6]}},
        np.eye(4),
    ),
    "overhead": ('<vector name="sun_direction" x="0" y="0" z="5"/>', {"sun_direction": [0, 0, 1]}, np.eye(4)),
    "a room with y up": (
        '<vector name="sun_direction" x="0.6" y="0.2" z="0.7"/><float name="sky_scale" value="3"/>'
        f'<float name="sun_scale" value="0.5"/>{FLAT}',
        {"sun_direction": [0.6, 0.2, 0.7], "sky_scale": 3.0, "sun_scale": 0.5},
        None,
    ),
    "evening": ('<float name="hour" value="18.2"/>', {"hour": 18.2}, np.eye(4)),
}  # fmt: skip


@pytest.mark.parametrize("name", PLACES)
def test_daylight_is_mitsubas(tmp_path, name, request):
    """Of a coarse map where the sun is so bright that it stands out of the sky there, too."""
    inside, described, pose = PLACES[name]
    is_coarse = name in ("as it is", "overhead")
    if is_coarse:
        request.getfixturevalue("coarse")
    texel = math.pi / (baking.HEIGHT - 1)
    environment = read(tmp_path, daylight("sunsky", inside)).environment
    mi.set_variant("scalar_rgb")
    if pose is None:
        turn = mi.ScalarTransform4f().rotate([0, 1, 0], 30) @ mi.ScalarTransform4f().rotate([1, 0, 0], -90)
        described = described | {"to_world": turn}
        pose = np.array(turn.matrix)
    # ---------------------- The sky ----------------------
    sky = mi.load_dict({"type": "sunsky", **described, "sun_scale": 0.0})
    whole = mi.load_dict({"type": "sunsky", **described})
    sun = np.array(mi.traverse(whole)["sun_direction"])
    sun = pose[:3, :3] @ sun if "sun_direction" not in described else sun / np.linalg.norm(sun)
    d = np.random.default_rng(0).normal(size=(500, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    height = d @ pose[:3, 2]
    d = d[(np.abs(height) > 2 * texel) & (d @ sun < math.cos(math.radians(3)))]
    ours = Environment(environment).radiance(torch.from_numpy(d.astype(np.float32))).numpy()
    theirs = values(sky, d)
    assert (theirs[d @ pose[:3, 2] < 0] == 0).all()
    np.testing.assert_allclose(ours, theirs, rtol=1e-2 if is_coarse else 5e-3, atol=1e-6)
    # ---------------------- The sun, as a whole ----------------------
    alone = mi.load_dict({"type": "sunsky", **described, "sky_scale": 0.0})
    grid = (np.arange(20) + 0.5) / 20
    here = mi.Interaction3f()
    power = np.mean([alone.sample_direction(here, [a, b])[1] for a in grid for b in grid], 0)
    towards, found = sun_of(environment)
    assert math.acos(min(float(towards @ sun), 1.0)) < texel
    np.testing.assert_allclose(found, power, rtol=0.01)


def test_daylight_of_old_files(tmp_path, coarse):
    """Y is up there, and the compass has east at +X and north at -Z."""
    new = read(tmp_path, daylight("sunsky"))
    old = read(tmp_path, daylight("sunsky", '<spectrum name="albedo" value="0.3"/>'), "0.5.0")
    (south, west, up), _ = sun_of(new.environment)
    towards, power = sun_of(old.environment)
    np.testing.assert_allclose(towards, [-west, up, south], atol=4 * TEXEL)
    assert up == pytest.approx(math.sin(math.radians(46.1)), abs=0.02)  # of Tokyo, on a day of July at three
    np.testing.assert_allclose(power, sun_of(new.environment)[1], rtol=1e-3)
    np.testing.assert_allclose(old.environment.pixels.mean((0, 1)), new.environment.pixels.mean((0, 1)), rtol=0.02)
    assert "the sun 46.1 degrees high" in old.notes[0]
    # ---------------------- Other names, and emitters of one part ----------------------
    given = (
        '<vector name="sunDirection" x="1" y="2" z="3"/><float name="scale" value="2"/>'
        '<float name="sunRadiusScale" value="3"/><integer name="resolution" value="512"/>'
        '<transform name="toWorld"><rotate y="1" angle="70"/></transform>'
    )
    both = read(tmp_path, daylight("sunsky", given), "0.6.0").environment
    parts = read(tmp_path, daylight("sky", given) + daylight("sun", given), "0.6.0").environment
    np.testing.assert_allclose(parts.pixels, both.pixels, rtol=1e-5)
    np.testing.assert_array_equal(parts.to_world, both.to_world)
    towards, power = sun_of(both)
    np.testing.assert_allclose(towards, np.array([1, 2, 3]) / math.sqrt(14), atol=4 * TEXEL)
    sky = read(tmp_path, daylight("sky", given), "0.6.0").environment
    assert 0.0 < sky.pixels.max() < 3.0
    assert Environment(sky).radiance(torch.tensor([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]]))[:, 1].tolist()[1] == 0.0


# ---- BSDFs


def shaped(bsdf):
    return f'<shape type="rectangle">{bsdf}</shape>'


def weights(bsdf, cosine, count=4000):
    """What Mitsuba's BSDF reflects of light at a cosine [3]: its mean weight."""
    rng, si, total = np.random.default_rng(1), mi.SurfaceInteraction3f(), np.zeros(3)
    si.wi = [math.sqrt(1 - cosine**2), 0.0, cosine]
    for u in rng.random((count, 3)):
        total += list(bsdf.sample(mi.BSDFContext(), si, u[0], u[1:].tolist())[1])
    return total / count


@pytest.mark.parametrize("nonlinear", [False, True])
def test_plastic_is_rough_plastic_with_a_small_alpha(tmp_path, nonlinear):
    inside = (
        '<rgb name="diffuse_reflectance" value="0.2, 0.5, 0.8"/><float name="int_ior" value="1.6"/>'
        f'<boolean name="nonlinear" value="{str(nonlinear).lower()}"/>'
    )
    scene = read(tmp_path, "", shapes=shaped(f'<bsdf type="plastic" id="shell">{inside}</bsdf>'))
    (material,) = scene.materials
    assert isinstance(material.model, RoughPlasticModel)
    assert material.model.alpha == PLASTIC_ALPHA
    assert scene.notes == (f"smooth plastic is read as roughplastic with an alpha of {PLASTIC_ALPHA:g}: shell",)
    mi.set_variant("scalar_rgb")
    theirs = mi.load_dict({
        "type": "plastic", "int_ior": 1.6, "nonlinear": nonlinear,
        "diffuse_reflectance": {"type": "rgb", "value": [0.2, 0.5, 0.8]},
    })  # fmt: skip
    ours = make_bsdf(Features(False, False, False, False, False, models=(material.model,)))
    surface = Surface(torch.tensor([[0.2, 0.5, 0.8]]), torch.ones(1, 1), model=torch.zeros(1, dtype=torch.int64))
    for cosine in (0.3, 0.7, 0.98):
        wo = torch.tensor([[math.sqrt(1 - cosine**2), 0.0, cosine]])
        np.testing.assert_allclose(ours.mean_weight(surface, wo)[0], weights(theirs, cosine), rtol=0.03)
        wi = torch.tensor([[0.1, 0.6, 0.79]])  # off its highlight it is the base alone
        wi = wi / wi.norm()
        si = mi.SurfaceInteraction3f()
        si.wi = wo[0].tolist()
        value = list(theirs.eval(mi.BSDFContext(), si, wi[0].tolist()))
        np.testing.assert_allclose(ours.eval(surface, wo, wi)[0], value, rtol=0.03)


def test_beckmann_becomes_ggx(tmp_path):
    metal = '<bsdf type="roughconductor" id="{}"><string name="material" value="Cu"/><float name="alpha" value="{}"/>{}'
    default, beckmann, ggx = (
        "",
        '<string name="distribution" value="beckmann"/>',
        '<string name="distribution" value="ggx"/>',
    )
    given = zip("abc", (0.2, 0.5, 0.5), (default, beckmann, ggx), strict=True)
    scene = read(tmp_path, "", shapes="".join(shaped(metal.format(*x) + "</bsdf>") for x in given))
    alphas = [material.model.alpha for material in scene.materials]
    np.testing.assert_allclose(alphas, [0.2 * BECKMANN, 0.5 * BECKMANN, 0.5], rtol=1e-6)
    assert scene.notes == ("a beckmann distribution is read as ggx with 0.873 of its alpha, which comes nearest: a, b",)
    # ---------------------- It comes nearest of all widths ----------------------
    r = np.linspace(0.0, 200.0, 2_000_001)

    def distance(c):
        return np.trapezoid(np.abs(2 * r * c * c / (c * c + r * r) ** 2 - 2 * r * np.exp(-r * r)), r)

    assert distance(BECKMANN) < min(distance(BECKMANN - 0.01), distance(BECKMANN + 0.01))


def test_all_that_stands_in_the_way_of_shapes_is_said_once_each(tmp_path):
    bsdfs = '<bsdf type="mask" id="m"><bsdf type="diffuse"/></bsdf><bsdf type="roughdielectric" id="t"/>'
    file = '<string name="filename" value="{}.obj"/>'
    shapes = "".join(
        f'<shape type="obj" id="{name}">{file.format(name)}<ref id="{bsdf}"/></shape>'
        for name, bsdf in zip("abc", "mtm", strict=True)
    )
    checkered = '<emitter type="area"><texture type="checkerboard" name="radiance"/></emitter>'
    fog = '<medium type="homogeneous" name="interior"/>'
    lamps = f'<shape type="rectangle" id="e">{checkered}<bsdf type="hair" id="fur"/>{fog}</shape>'
    mirror = '<emitter type="area"/><bsdf type="conductor"/></shape>'
    lamps += "".join(f'<shape type="rectangle" id="{name}">{mirror}' for name in "fg")
    with pytest.raises(InputError) as found:
        read(tmp_path, bsdfs, shapes=shapes + '<shape type="hair" id="d"/>' + lamps)
    said = str(found.value)
    assert said.startswith("11 things stand in the way: (1) ")
    for part in ("shape a in", "shape b in", "shape c in", "bsdf m of", "bsdf t of", "shape d has type hair",
                 "light of shape e is a texture", "bsdf fur of shape e", "shape e has a medium",
                 "mesh f emits light and is smooth", "mesh g emits light and is smooth"):  # fmt: skip
        assert said.count(part) == 1, part
