"""Size and place of the scene, bad triangles, huge meshes."""

from dataclasses import replace

import numpy as np
import torch

from benchmarks.stress.case import Case, Outcome
from benchmarks.stress.fit import Fit, Plan, photographs, resized
from benchmarks.stress.scenes import difference, mean_difference, moved, picture, small_cube, with_meshes
from neurad.core.records import Rays
from neurad.core.rng import Stream
from neurad.core.scene_records import Mesh
from neurad.scene.builtin.shapes import look_at
from neurad.scene.description import Scene
from neurad.tracing.select import make_tracer

SPOILT = ("needles", "degenerate triangles", "duplicated triangles", "flipped triangles", "missing UVs")


def _scaled(scale: float, offset: float, bar: float) -> Case:
    def measure(quick: bool) -> Outcome:
        scene = small_cube()
        other = moved(scene, scale, offset)
        if scale != 1.0:  # radiance does not depend on the scale
            return Outcome(mean_difference(picture(other, 32), picture(scene, 32)), bar)
        return Outcome(mean_difference(picture(other, 32), picture(scene, 32)), bar, "means of the pictures")

    what = f"scene of size {2 * scale:g}" + (f" at offset {offset:g}" if offset else "")
    return Case("shapes", what, "the same picture as at size 2", measure)


def _fitted(scale: float, offset: float) -> Case:
    def measure(quick: bool) -> Outcome:
        scene = resized(small_cube(12), 12, 4)
        images = photographs(scene, 16)
        plan = Plan(steps=60 if quick else 300)
        here, there = (Fit(s, images, plan).run().albedo_error()[0] for s in (scene, moved(scene, scale, offset)))
        return Outcome(abs(here - there), 0.02, f"albedo error {there:.4f}, at the origin {here:.4f}")

    return Case("shapes", f"fitted at size {2 * scale:g}, offset {offset:g}", "albedo error of the scene as it was",
                measure, scale == 1e-3)  # fmt: skip


def _one_triangle() -> Case:
    def measure(quick: bool) -> Outcome:
        scene = small_cube(16)
        vertices = np.array([[-1, 0, -1], [1, 0, -1], [0, 0, 1]], np.float32)
        mesh = Mesh("triangle", vertices, np.array([[0, 2, 1]]), 0, radiance=np.ones(3, np.float32))
        view = replace(scene.train[0], camera=look_at((0.0, 2.0, 0.0), (0.0, 0.0, 0.01), 60.0, 64))
        found = picture(replace(scene, meshes=[mesh], train=[view]), 16)
        # area seen: 2 of the (2 * 2 tan 30)^2 at distance 2; nothing can reflect
        fraction = 2.0 / (4.0 * np.tan(np.radians(30.0))) ** 2
        return Outcome(abs(float(found.mean()) / fraction - 1.0), 0.02, "its fraction of the picture")

    return Case("shapes", "one triangle, which is the light", "closed form, mean of the picture", measure)


def grid_mesh(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """A wavy square of about ``count`` triangles: vertices [v, 3] and faces [f, 3]."""
    side = int(np.sqrt(count / 2)) + 1
    x, z = np.meshgrid(np.linspace(-1, 1, side), np.linspace(-1, 1, side), indexing="ij")
    y = 0.05 * np.sin(9 * x) * np.cos(7 * z)
    vertices = np.stack((x, y, z), -1).reshape(-1, 3).astype(np.float32)
    a = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).reshape(-1)
    faces = np.concatenate((np.stack((a, a + 1, a + side), -1), np.stack((a + 1, a + side + 1, a + side), -1)))
    return torch.from_numpy(vertices), torch.from_numpy(faces)


def _many() -> Case:
    def measure(quick: bool) -> Outcome:
        vertices, faces = grid_mesh(50_000 if quick else 5_000_000)
        tracer = make_tracer("embree", vertices, faces)
        u = Stream(1).uniform(100_000, 2)
        o = torch.stack((1.9 * u[:, 0] - 0.95, torch.ones(len(u)), 1.9 * u[:, 1] - 0.95), -1)
        hit = tracer.closest(Rays(o, torch.tensor([0.0, -1.0, 0.0]).expand(len(u), 3).contiguous()))
        height = 1.0 - hit.t
        truth = 0.05 * torch.sin(9 * o[:, 0]) * torch.cos(7 * o[:, 2])
        missed = int((~hit.valid).sum())
        error = float((height - truth)[hit.valid].abs().max()) + missed
        return Outcome(error, 1e-3 if quick else 1e-5, f"{len(faces)} triangles, {missed} rays of {len(u)} missed it")

    return Case("shapes", "5 million triangles (quick: 50 thousand)", "height of a wavy floor, closed form", measure)


def _spoilt(what: str, bar: float) -> Case:
    """Bad triangles, which must not change the picture."""

    def measure(quick: bool) -> Outcome:
        scene = small_cube()
        walls = scene.meshes[0]
        found = picture(replace(scene, meshes=[_spoil(walls, what), *scene.meshes[1:]]), 32)
        return Outcome(mean_difference(found, picture(scene, 32)), bar, "means of the pictures")

    return Case("shapes", what, "the same picture without", measure)


def _spoil(mesh: Mesh, what: str) -> Mesh:
    """A mesh with bad triangles added; all of them are two-sided walls."""
    if what == "degenerate triangles":
        return replace(mesh, faces=np.concatenate((mesh.faces, mesh.faces[:, [0, 0, 1]], mesh.faces[:, [2, 2, 2]])))
    if what == "duplicated triangles":
        return replace(mesh, faces=np.concatenate((mesh.faces, mesh.faces)))
    if what == "flipped triangles":
        faces = mesh.faces.copy()
        faces[::2] = faces[::2, ::-1]
        return replace(mesh, faces=faces)
    if what == "missing UVs":
        return replace(mesh, uvs=None)
    parts, count = [], len(mesh.vertices)  # needles: every triangle cut into slivers of 1/2000 of its width
    vertices = [mesh.vertices]
    cuts = np.linspace(0.0, 1.0, 2001)
    for a, b, c in mesh.faces:
        edge = mesh.vertices[b] + cuts[:, None] * (mesh.vertices[c] - mesh.vertices[b])
        vertices.append(edge.astype(np.float32))
        first = count + np.arange(2000)
        parts.append(np.stack((np.full(2000, a), first, first + 1), -1))
        count += len(cuts)
    return replace(mesh, vertices=np.concatenate(vertices), faces=np.concatenate(parts), uvs=None, normals=None)


def _hole() -> Case:
    """A room without one wall: light that leaves does not return."""

    def measure(quick: bool) -> Outcome:
        scene = small_cube(16)
        walls = scene.meshes[0]
        open_room = replace(scene, meshes=[replace(walls, faces=walls.faces[:-2]), *scene.meshes[1:]])
        images = photographs(resized(open_room, 12, 4), 16)
        fit = Fit(resized(open_room, 12, 4), images, Plan(steps=60 if quick else 300)).run()
        error, mean = fit.albedo_error()
        darker = float(picture(open_room, 32).mean() / picture(scene, 32).mean())
        return Outcome(max(0.0, darker - 1.0) + max(0.0, error - 0.25), 0.0,
                       f"{darker:.3f} times as bright, albedo error {error:.3f}, mean {mean:.3f}")  # fmt: skip

    return Case("shapes", "a room with a hole", "finite, darker than closed, fit below the best constant", measure)


def _no_normals() -> Case:
    def measure(quick: bool) -> Outcome:
        from neurad.scene.builtin import build

        scene = build("patterns")
        view = replace(scene.train[0], camera=replace(scene.train[0].camera, width=24, height=24))
        bare: Scene = with_meshes(replace(scene, train=[view]), lambda m: replace(m, normals=None))
        found, usual = picture(bare, 16, depth=3), picture(replace(scene, train=[view]), 16, depth=3)
        return Outcome(
            difference(found, usual) if quick else mean_difference(found, usual), 0.2, "flat in place of smooth shading"
        )

    return Case("shapes", "missing normals (patterns)", "picture with normals, roughly", measure, False)


def cases() -> list[Case]:
    """Size, place, triangles."""
    return [
        *(_scaled(s, 0.0, 1e-3) for s in (1e-3, 1e3, 1e5)),
        _scaled(1.0, 1e5, 0.05),
        _scaled(1e3, 1e5, 2e-3),
        _fitted(1e-3, 0.0),
        _fitted(1e3, 1e5),
        _one_triangle(),
        _many(),
        *(_spoilt(what, 0.02) for what in SPOILT),
        _no_normals(),
        _hole(),
    ]
