"""Mitsuba 3 scene files, read through the optional ``mitsuba`` package in the ``scalar_rgb`` variant, without LLVM.

Mitsuba parses the XML and hands out the meshes, so defaults, includes, references, transforms and file formats are its
own. Textures are read by :mod:`neurad.images.image_io`, and nothing is ever built for Mitsuba to trace.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from neurad.core.errors import InputError, Refusals
from neurad.core.records import Float64Array, FloatArray
from neurad.core.scene_records import Bitmap, Constant, EnvironmentMap, Mesh, PunctualLight, constant
from neurad.formats.gltf.lamps import lit_by
from neurad.formats.mitsuba.lights import HEIGHT, OLD, OWN, PUNCTUAL, SOURCES, WIDTH, bake, read_punctual
from neurad.formats.mitsuba.materials import MaterialReader
from neurad.formats.mitsuba.mesh_files import check_mesh_file, moved_file
from neurad.formats.mitsuba.plugin import SCALAR, mitsuba_as
from neurad.formats.mitsuba.shapes import CURVED, ERROR, Triangles, is_round, triangulated
from neurad.formats.mitsuba.xml_check import check_xml, found_in
from neurad.runtime.extras import needed
from neurad.runtime.numbers import LENGTH, RADIANCE, TEXEL, UNIT, number, within
from neurad.runtime.reading import native, shown
from neurad.scene.description import Scene, check_mesh
from neurad.scene.origin import ZERO
from neurad.scene.polygons import check_triangle_count

_MESHES = ("ply", "obj", "serialized", "rectangle", "cube", *CURVED)
_IN_FILES = ("ply", "obj", "serialized")
_NOISE = re.compile(r'\[[\w.]+(:\d+)?\] *|At dictionary node "\w+": |failed to instantiate \w+ plugin of type "\w+": ')
_UNLIMITED = 2**31 - 1
_RIGID = 1e-4  # largest deviation of an environment's axes from orthonormal ones
_GROUND = constant(0.3, 3)  # where a sky has no albedo
_IGNORED = ("Sensor", "Integrator", "BSDF", "Texture", "Film", "Sampler", "ReconstructionFilter")


def read_xml(path: str | Path, origin: Float64Array = ZERO) -> Scene:
    """Geometry, materials, lights and depths of a Mitsuba scene file; cameras are not read.

    Vertices are in world space, and the winding of emitters is such that they shine to the side they do in Mitsuba.

    Args:
        origin: subtracted from all places [3] as float64, before Mitsuba makes float32 of them.

    Raises:
        InputError: the package or a file is missing, the XML is wrong, or the scene uses what neurad cannot render.
    """
    path = Path(path)
    folders, is_old = check_xml(path)
    with needed("mitsuba", "mitsuba", f"{path}: reading it"):
        import mitsuba
    if not hasattr(mitsuba, "parser"):
        raise InputError(f"{path}: reading it needs mitsuba 3.7 or newer: pip install 'neurad[mitsuba]'")
    with mitsuba_as(SCALAR) as mi:
        try:
            with TemporaryDirectory() as folder:
                return _Reader(mi, path, folders, is_old, origin, Path(folder)).scene()
        except MemoryError as error:
            raise InputError(f"{shown(path)}: there is not enough memory for its meshes and textures") from error
        except RecursionError as error:
            raise InputError(f"{shown(path)}: its BSDFs refer to one another through too many others") from error
        except UnicodeDecodeError as error:  # of names and values in encodings that are not declared
            raise InputError(f"{shown(path)}: it has text that is not in the encoding it declares") from error


@dataclass
class _Reader:
    """One scene file on its way to a Scene."""

    mi: Any
    path: Path
    folders: list[Path]
    is_old: bool
    origin: Float64Array
    folder: Path
    """For mesh files that are moved near the origin."""
    meshes: list[Mesh] = field(default_factory=list)
    triangles: int = 0
    environment: EnvironmentMap | None = None
    daylight: bool = False
    """Whether the environment is sun and sky."""
    punctual: list[PunctualLight] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    refusals: Refusals = field(default_factory=Refusals)

    def scene(self) -> Scene:
        nodes = self._parse()
        self.materials = MaterialReader(self.mi, self.path, self.folders, nodes)
        limits = 20, 8
        for child in self.materials.textures.references(nodes[0]).values():
            kind = child.type.name
            with self.refusals.part():
                if kind == "Shape":
                    self._shape(child)
                elif kind == "Emitter":
                    self._emitter(child)
                elif kind == "Integrator":
                    limits = self._limits(self._tracing(child).props)
                elif kind not in _IGNORED:
                    what = f"{kind.lower()} of type {child.props.plugin_name()}"
                    raise InputError(f"{self.path}: {what} is not supported")
        self.refusals.end()
        self.notes += self.materials.notes
        name = self.path.resolve().parent.name
        return Scene(
            name, self.meshes, self.materials.materials, self.environment, max_depth=limits[0], rr_depth=limits[1],
            punctual=tuple(self.punctual), notes=tuple(self.notes),
        )  # fmt: skip

    def _tracing(self, integrator: Any) -> Any:
        """The integrator that traces paths: what only records beside it (``aov``, ``moment``) has it inside."""
        children = self.materials.textures.references(integrator).values()
        inside = [child for child in children if child.type.name == "Integrator"]
        return self._tracing(inside[0]) if inside else integrator

    def _limits(self, props: Any) -> tuple[int, int]:
        max_depth, rr_depth = self._integer(props, "max_depth", -1), self._integer(props, "rr_depth", 5)
        if max_depth < -1 or max_depth == 0:
            raise InputError(
                f"{self.path}: its integrator has max_depth {max_depth}, which must be at least 1, or -1 for no limit"
            )
        if rr_depth < 1:
            raise InputError(f"{self.path}: its integrator has rr_depth {rr_depth}, which must be at least 1")
        return (_UNLIMITED if max_depth == -1 else min(max_depth, _UNLIMITED)), min(rr_depth, _UNLIMITED)

    def _integer(self, props: Any, key: str, default: int) -> int:
        value = props.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int):
            raise InputError(f"{self.path}: its integrator has {key} {shown(value)}, which is not an integer")
        return value

    def _parse(self) -> Any:
        parser = self.mi.parser
        config = parser.ParserConfig(SCALAR)
        with native(self.path, _reason):
            state = parser.parse_file(config, str(self.path))
            parser.transform_upgrade(config, state)
            parser.transform_resolve(config, state)
        return state.nodes

    def _shape(self, node: Any) -> None:
        props = node.props
        plugin, label = props.plugin_name(), props.id() or f"shape {len(self.meshes)}"
        if plugin not in _MESHES:
            raise InputError(f"{self.path}: shape {label} has type {plugin}; there are: {', '.join(_MESHES)}")
        own: dict[str, Any] = {}
        for child in self.materials.textures.references(node).values():
            kind = child.type.name
            with self.refusals.part():
                if kind not in ("BSDF", "Emitter"):
                    what = f"{kind.lower()} of type {child.props.plugin_name()}"
                    raise InputError(f"{self.path}: shape {label} has a {what}, which is not supported")
                if kind in own:
                    raise InputError(f"{self.path}: shape {label} has more than one {kind.lower()}")
                own[kind] = child
        shape = material = radiance = picture = None
        shines = "Emitter" in own
        if shines:
            with self.refusals.part():
                radiance, picture = self._radiance(own["Emitter"], label)
        with self.refusals.part():
            shape = self._load(props, label)
        with self.refusals.part():
            material = self.materials.index(own.get("BSDF"), label, shines)
        if shape is None or material is None or (shines and radiance is None):
            return
        mesh = self._mesh(shape, label, material, radiance)
        check_mesh(mesh, self.materials.materials[material], f"{self.path}: ")
        self.triangles += len(mesh.faces)
        check_triangle_count(self.triangles, f"{shown(self.path)}: with shape {shown(label)}")
        self.meshes += [mesh] if picture is None else self._lit(mesh, picture)

    def _lit(self, mesh: Mesh, picture: Bitmap) -> list[Mesh]:
        """A mesh that shines by a picture, as meshes of one radiance each."""
        if mesh.uvs is None:
            raise InputError(f"{self.path}: shape {mesh.name} shines by a picture, but has no texture coordinates")
        within(mesh.uvs, f"{self.path}: the texture coordinates of shape {mesh.name}", -TEXEL, TEXEL)
        return lit_by(picture, mesh, mesh.uvs, {mesh.name}, f"shape {mesh.name}", self.notes.append)

    def _load(self, props: Any, label: str) -> Any:
        """Mitsuba's own mesh, alone: without a scene no acceleration structure is built."""
        described: dict[str, Any] = {"type": props.plugin_name()}
        for name in props:
            if props.type(name) != self.mi.Properties.Type.ResolvedReference:
                described[name] = props[name]
        self._transform(props, f"shape {label}")
        file, plugin = self.path, props.plugin_name()
        if plugin in _IN_FILES:
            file = self._file(props, f"shape {label}")
            index = int(number(props.get("shape_index", 0), f"{self.path}: shape {label}: shape_index", 0, _UNLIMITED))
            check_mesh_file(file, plugin, f"the mesh of shape {label} in {self.path.name} is missing", index)
            described["filename"] = str(file)
        if self.origin.any():
            self._move(described, props)
        shape = self._plugin(file, f"shape {label}", described)
        return self._triangulated(shape, props, label) if plugin in CURVED else shape

    def _plugin(self, file: Path, where: str, described: Mapping[str, Any]) -> Any:
        with native(file, lambda error: f"{where}: {_reason(error)}"):
            return self.mi.load_dict(dict(described))

    def _move(self, described: dict[str, Any], props: Any) -> None:
        """Subtract the origin from a shape, and take what its own coordinates lie off into its transform."""
        plugin, pose, step = described["type"], np.eye(4), np.zeros(3)
        if "to_world" in props:
            pose = np.array(props["to_world"].matrix, np.float64)
        if plugin in ("ply", "obj"):
            moved, step = moved_file(Path(described["filename"]), plugin, self.folder / f"{len(self.meshes)}.{plugin}")
            described["filename"] = str(moved)
        for key in ("center", "p0"):
            if key in props:
                step = np.array(props[key], np.float64)
                described[key] = [0.0, 0.0, 0.0]
        if "p1" in props:
            described["p1"] = (np.array(props["p1"], np.float64) - step).tolist()
        pose[:3, 3] += pose[:3, :3] @ step - self.origin
        described["to_world"] = self.mi.ScalarTransform4f(pose)

    def _triangulated(self, shape: Any, props: Any, label: str) -> Triangles:
        plugin = props.plugin_name()
        pose = np.array(self.mi.traverse(shape)["to_world"].matrix, np.float64)
        if not np.isfinite(pose).all() or np.linalg.det(pose[:3, :3]) == 0.0:
            raise InputError(f"{self.path}: shape {label} is a {plugin} without an extent, or one of no finite size")
        if not is_round(plugin, pose):
            raise InputError(
                f"{self.path}: the to_world of shape {label} stretches a {plugin}, which Mitsuba cannot do either; "
                "export it as a triangle mesh (ply or obj)"
            )
        made = triangulated(plugin, pose)
        self.notes.append(
            f"shape {label} is a {plugin}: it is read as {len(made.faces)} triangles with its exact normals, at most "
            f"{ERROR[plugin]:.1g} of its radius off"
        )
        flipped = shape.has_flipped_normals()  # false of a disk, whose pose has it already
        if plugin == "cylinder" and np.linalg.det(pose[:3, :3]) < 0:  # the flag makes up for the mirrored pose there
            flipped = not flipped
        if flipped:
            return made._replace(faces=made.faces[:, [0, 2, 1]], normals=-made.normals)
        return made

    def _file(self, props: Any, where: str) -> Path:
        """The file that an element names, relative to the scene file or to a ``<path>``."""
        name = props.get("filename", None)
        if not isinstance(name, str) or not name:
            raise InputError(f"{self.path}: {where} has no filename")
        return found_in(self.folders, name)

    def _transform(self, props: Any, where: str) -> FloatArray:
        """The ``to_world`` of an element [4, 4]."""
        if "to_world" not in props:
            return np.eye(4, dtype=np.float32)
        with np.errstate(over="ignore", invalid="ignore"):  # what float32 cannot hold is said below
            matrix = np.array(getattr(props["to_world"], "matrix", np.nan))
            if matrix.shape == (4, 4):
                matrix[:3, 3] -= self.origin
            matrix = matrix.astype(np.float32)
            inverts = matrix.shape == (4, 4) and np.linalg.det(matrix[:3, :3].astype(np.float64)) != 0
        if not inverts or not np.isfinite(matrix).all():
            raise InputError(f"{self.path}: the to_world of {where} is not a transform that can be inverted")
        return matrix

    def _mesh(self, shape: Any, label: str, material: int, radiance: FloatArray | None) -> Mesh:
        vertices, faces, normals, uvs = _arrays(shape)
        count = len(vertices)
        within(vertices, f"{self.path}: the world coordinates of shape {label}", -LENGTH, LENGTH)
        if normals is not None and not np.isfinite(normals).all():  # as if the file had a zero normal there
            normals[~np.isfinite(normals).all(-1)] = 0.0
        if uvs is not None and self.materials.has_bitmaps(material):
            within(uvs, f"{self.path}: the texture coordinates of shape {label}", -TEXEL, TEXEL)
        elif uvs is not None and not np.isfinite(uvs).all():  # nothing reads them
            uvs[~np.isfinite(uvs).all(-1)] = 0.0
        if len(faces) and int(faces.max()) >= count:
            raise InputError(f"{self.path}: shape {label} has triangles with vertices that do not exist")
        if not isinstance(shape, Triangles) and shape.has_flipped_normals():
            faces = faces[:, [0, 2, 1]]
            normals = None if normals is None else -normals
        if radiance is not None and normals is not None:
            faces = _wound_like_normals(vertices, faces, normals)
        attributes: dict[str, FloatArray] = {}
        for name in sorted(self.materials.attributes(material)):
            known = not isinstance(shape, Triangles) and name.startswith("vertex_") and shape.has_attribute(name)
            if not known:
                raise InputError(f"{self.path}: shape {label} has no vertex attribute {name}")
            attributes[name] = np.array(shape.attribute_buffer(name), np.float32).reshape(count, -1)
            within(attributes[name], f"{self.path}: the attribute {name} of shape {label}", 0.0, UNIT)
        return Mesh(label, vertices, faces, material, normals, uvs, attributes, radiance)

    def _radiance(self, node: Any, label: str) -> tuple[FloatArray, Bitmap | None]:
        """What a shape emits, and the picture that this is multiplied by."""
        plugin = node.props.plugin_name()
        if plugin != "area":
            raise InputError(f"{self.path}: shape {label} has an emitter of type {plugin}, only area is supported")
        where = f"the area light of shape {label}"
        if (picture := self.materials.textures.emitted(node, "radiance", where)) is not None:
            self._only(node.props, where, ("radiance", "sampling_weight"))
            return np.ones(3, np.float32), picture
        self._plain(node, f"the emitter on shape {label}")
        return self._emission(node.props, where), None

    def _plain(self, node: Any, where: str) -> None:
        """Check that an emitter has no textures."""
        for name, child in self.materials.textures.references(node).items():
            raise InputError(f"{self.path}: the {name} of {where} is a {child.props.plugin_name()}, not a constant")

    def _emission(self, props: Any, where: str, *others: str, key: str = "radiance") -> FloatArray:
        """The constant radiance, or what ``key`` says [3], of an emitter that may have ``others`` beside it."""
        self._only(props, where, (key, "sampling_weight", *others))
        if key not in props:
            return np.ones(3, np.float32)
        with native(self.path, f"the {key} of {where} is not a colour"):
            texture = props.get_emissive_texture(key)
            value = np.array(texture.eval(self.mi.SurfaceInteraction3f()), np.float32).reshape(-1)
        within(value, f"{self.path}: the {key} of {where}", 0.0, RADIANCE)
        return value * np.ones(3, np.float32)

    def _only(self, props: Any, where: str, known: tuple[str, ...]) -> None:
        """Check that an emitter has no other parameters: what is not read would change the light."""
        if other := next((key for key in props if key not in known), None):
            raise InputError(
                f"{self.path}: {where} sets {other}, which is not supported; there are: {', '.join(known)}"
            )

    def _emitter(self, node: Any) -> None:
        props = node.props
        plugin = props.plugin_name()
        if plugin in PUNCTUAL:
            self._punctual(node)
        elif plugin in SOURCES:
            self._daylight(node)
        elif self.environment is not None and plugin in ("constant", "envmap"):
            raise InputError(f"{self.path}: it has more than one environment emitter")
        elif plugin == "constant":
            radiance = self._emission(props, "the constant emitter", "to_world")
            self.environment = EnvironmentMap(np.broadcast_to(radiance, (2, 4, 3)).copy())
        elif plugin == "envmap":
            self._only(props, "the envmap", ("filename", "scale", "to_world", "sampling_weight", "mis_compensation"))
            self.environment = self._map(props)
        else:
            there = ", ".join(("area", "envmap", "constant", *SOURCES, *PUNCTUAL))
            raise InputError(f"{self.path}: emitter of type {plugin} is not supported; there are: {there}")

    def _daylight(self, node: Any) -> None:
        """Bake sun and sky; those of two emitters become one map."""
        props, plugin = node.props, node.props.plugin_name()
        where, is_old = f"the {plugin}", self.is_old or plugin != "sunsky"
        self._only(props, where, (*OWN, *(OLD if is_old else ()), "to_world", "sampling_weight"))
        ground = self.materials.textures.texture(node, "albedo", where, _GROUND)
        if not isinstance(ground, Constant):
            raise InputError(f"{self.path}: the albedo of {where} is a texture, not a constant")
        given = {key: props[key] for key in props if key != "albedo"}
        albedo = None if ground is _GROUND else ground.value
        load = partial(self._plugin, self.path, where)
        turn = self._turn(props, where)
        made, height = bake(load, f"{self.path}: {where}", plugin, given, albedo, turn, is_old)
        if self.environment is not None:
            if not (self.daylight and np.allclose(self.environment.to_world, made.to_world)):
                raise InputError(f"{self.path}: it has more than one environment emitter")
            made = replace(made, pixels=made.pixels + self.environment.pixels)
        self.environment, self.daylight = made, True
        self.notes.append(
            f"{where} is baked into an environment map of {WIDTH} x {HEIGHT}, the sun {height:.1f} degrees high"
        )

    def _punctual(self, node: Any) -> None:
        props = node.props
        plugin = props.plugin_name()
        name = props.id() or f"{plugin}-{len(self.punctual) + 1}"
        where = f"the {plugin} emitter {name}"
        self._plain(node, where)
        key, *others = PUNCTUAL[plugin]
        intensity = self._emission(props, where, *others, key=key)
        to_world = self._transform(props, where)
        self.punctual.append(read_punctual(props, name, intensity, to_world, f"{self.path}: {where}", self.origin))

    def _map(self, props: Any) -> EnvironmentMap:
        """The lat-long map of an envmap, with its scale and turn."""
        file, to_world = self._file(props, "the envmap"), self._turn(props, "the envmap")
        pixels = self.materials.textures.pixels(props["filename"], raw=False)
        scale = number(props.get("scale", 1.0), f"{self.path}: the scale of the envmap", 0.0, RADIANCE)
        with np.errstate(over="ignore"):
            scaled = np.broadcast_to(pixels, (*pixels.shape[:2], 3)) * np.float32(scale)
        times = "" if scale == 1.0 else f" times the scale {scale:g} in {self.path.name}"
        within(scaled, f"{file}: radiance{times}", 0.0, RADIANCE)
        return EnvironmentMap(scaled.astype(np.float32), to_world)

    def _turn(self, props: Any, where: str) -> FloatArray:
        """The ``to_world`` of what has no place [4, 4]: a rotation."""
        to_world = self._transform(props, where)
        axes = to_world[:3, :3].astype(np.float64)
        axes /= np.linalg.norm(axes, axis=0).mean()
        if not np.abs(axes.T @ axes - np.eye(3)).max() <= _RIGID:
            raise InputError(f"{self.path}: the to_world of {where} has to be a rotation")
        return to_world


def _arrays(shape: Any) -> tuple[FloatArray, np.ndarray, FloatArray | None, FloatArray | None]:
    """Vertices, faces, normals and texture coordinates of Mitsuba's mesh, or of triangles made here."""
    if isinstance(shape, Triangles):
        return shape
    count = shape.vertex_count()
    vertices = np.array(shape.vertex_positions_buffer(), np.float32).reshape(count, 3)
    faces = np.array(shape.faces_buffer()).reshape(-1, 3).astype(np.int64)
    normals = uvs = None
    if shape.has_vertex_normals():
        normals = np.array(shape.vertex_normals_buffer(), np.float32).reshape(count, 3)
    if shape.has_vertex_texcoords():
        uvs = np.array(shape.vertex_texcoords_buffer(), np.float32).reshape(count, 2)
    return vertices, faces, normals, uvs


def _wound_like_normals(vertices: FloatArray, faces: np.ndarray, normals: FloatArray) -> np.ndarray:
    """The faces, those turned whose winding opposes their vertex normals: Mitsuba's lights go by the normals."""
    p = vertices[faces]
    winding = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    opposed = (winding * normals[faces].sum(1)).sum(-1) < 0
    return np.where(opposed[:, None], faces[:, [0, 2, 1]], faces)


def _reason(error: Exception) -> str:
    """Mitsuba's message in one line, without the places in its own source code."""
    text = _NOISE.sub("", " ".join(str(error).split()))
    return text.rstrip(".!") or "Mitsuba cannot read it"
