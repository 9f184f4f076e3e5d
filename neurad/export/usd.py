"""``room.usdc``: meshes, ``UsdPreviewSurface`` materials, cameras and the environment, by the optional ``usd-core``.

Textures are those of ``scene.glb`` as files. As in the other files, vertices are those of the input and so are the
cameras; one rotation at the root turns rooms whose up axis USD does not know.
"""

from pathlib import Path
from typing import Any

import numpy as np
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdLux, UsdShade, Vt

from neurad.core.errors import InputError
from neurad.core.names import make_unique
from neurad.core.records import Array, FloatArray
from neurad.core.reflection import DielectricModel, PrincipledModel
from neurad.core.scene_records import EnvironmentMap, Material, Mesh, View
from neurad.export.bake import BakedRoom
from neurad.export.base_colour import Target, smooth_colour, texture_files
from neurad.export.gltf import unit_normals
from neurad.formats.axes import rotation
from neurad.formats.cameras.write import clip_planes, is_plain
from neurad.runtime.reading import quiet

FILE = "room.usdc"
METERS_PER_UNIT = 1.0
"""A scene does not say how long its unit is; a metre is what glTF takes it for, too."""
FILM = 0.36
"""Width of the film, in tenths of a unit as USD has it: 36 mm."""


def write_usd(room: BakedRoom, folder: Path, target: Target) -> None:
    """Write a room as ``room.usdc`` into a folder that has its textures already.

    Raises:
        InputError: the file cannot be written.
    """
    stage = Usd.Stage.CreateInMemory()
    _Stage(stage, room, target).fill()
    layer = Sdf.Layer.CreateAnonymous(".usdc")
    layer.TransferContent(stage.GetRootLayer())
    try:
        with quiet():
            written = layer.Export(str(folder / FILE))
    except Tf.ErrorException:
        written = False
    if not written:
        raise InputError(f"{folder / FILE}: usd-core cannot write it; is its disk full, or are large files forbidden?")


class _Stage:
    def __init__(self, stage: Any, room: BakedRoom, target: Target) -> None:
        self.stage = stage
        self.room = room
        self.target = target
        self._taken: set[str] = set()

    def fill(self) -> None:
        """Put everything on the stage."""
        up = "Z" if self.room.up == "z" else "Y"
        UsdGeom.SetStageUpAxis(self.stage, up)
        UsdGeom.SetStageMetersPerUnit(self.stage, METERS_PER_UNIT)
        root = UsdGeom.Xform.Define(self.stage, "/room")
        self.stage.SetDefaultPrim(root.GetPrim())
        self.stage.GetRootLayer().customLayerData = {"base_color_for": self.target, "up": self.room.up}
        pose = np.eye(4)
        if self.room.up not in ("y", "z"):
            pose[:3, :3] = rotation(self.room.up)
        pose[:3, 3] = pose[:3, :3] @ self.room.scene.origin
        if not np.array_equal(pose, np.eye(4)):
            root.AddTransformOp().Set(_matrix(pose))
        for scope in ("materials", "meshes", "cameras"):
            UsdGeom.Scope.Define(self.stage, f"/room/{scope}")
        scene = self.room.scene
        for index, mesh in enumerate(scene.meshes):
            material = scene.materials[mesh.material]
            surface = self._material(self.room.names[index], mesh, material, self.room.baked[index] is not None)
            self._mesh(self.room.names[index], mesh, material.two_sided, surface)
        for view in filter(lambda view: is_plain(view.camera), (*scene.train, *scene.test)):
            self._camera(view)
        if scene.environment is not None:
            self._environment(scene.environment)

    def _path(self, scope: str, name: str) -> str:
        return make_unique(f"/room/{scope}/{Tf.MakeValidIdentifier(name)}", self._taken, "_")

    def _mesh(self, name: str, mesh: Mesh, two_sided: bool, material: Any) -> None:
        prim = UsdGeom.Mesh.Define(self.stage, self._path("meshes", name))
        prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(_floats(mesh.vertices)))
        prim.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
        corners = np.ascontiguousarray(mesh.faces.ravel(), np.int32)
        prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(corners))
        prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        prim.CreateOrientationAttr(UsdGeom.Tokens.rightHanded)
        prim.CreateDoubleSidedAttr(two_sided)
        box = np.stack((mesh.vertices.min(0), mesh.vertices.max(0)))
        prim.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(_floats(box)))
        if mesh.normals is not None:
            prim.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(_floats(unit_normals(mesh))))
            prim.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
        if mesh.uvs is not None:
            uvs = np.stack((mesh.uvs[:, 0], 1.0 - mesh.uvs[:, 1]), 1)  # rows of USD's pictures count from below
            values = UsdGeom.PrimvarsAPI(prim).CreatePrimvar(
                "st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex
            )
            values.Set(Vt.Vec2fArray.FromNumpy(_floats(uvs)))
        UsdShade.MaterialBindingAPI.Apply(prim.GetPrim()).Bind(material)

    def _material(self, name: str, mesh: Mesh, material: Material, textured: bool) -> Any:
        made = UsdShade.Material.Define(self.stage, self._path("materials", name))
        path = str(made.GetPath())
        shader = UsdShade.Shader.Define(self.stage, f"{path}/surface")
        shader.CreateIdAttr("UsdPreviewSurface")
        made.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
        for key, kind, value in _inputs(mesh, material):
            shader.CreateInput(key, getattr(Sdf.ValueTypeNames, kind)).Set(value)
        colour = shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f)
        rough = shader.CreateInput("roughness", Sdf.ValueTypeNames.Float)
        if not textured:
            colour.Set(tuple(smooth_colour(material).tolist()))
            rough.Set(0.0)
            return made
        reader = UsdShade.Shader.Define(self.stage, f"{path}/st")
        reader.CreateIdAttr("UsdPrimvarReader_float2")
        reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
        st = reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)
        base_file, orm_file = texture_files(name)
        colour.ConnectToSource(self._texture(f"{path}/base_color", base_file, "sRGB", st, "rgb")["rgb"])
        orm = self._texture(f"{path}/orm", orm_file, "raw", st, "g", "b")
        rough.ConnectToSource(orm["g"])
        if not material.model.is_diffuse:
            shader.CreateInput("metallic", Sdf.ValueTypeNames.Float).ConnectToSource(orm["b"])
        return made

    def _texture(self, path: str, file: str, space: str, st: Any, *channels: str) -> dict[str, Any]:
        shader = UsdShade.Shader.Define(self.stage, path)
        shader.CreateIdAttr("UsdUVTexture")
        shader.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(Sdf.AssetPath(f"./{file}"))
        shader.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set(space)
        for wrap in ("wrapS", "wrapT"):
            shader.CreateInput(wrap, Sdf.ValueTypeNames.Token).Set("clamp")
        shader.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(st)
        kinds = Sdf.ValueTypeNames
        return {x: shader.CreateOutput(x, kinds.Float3 if x == "rgb" else kinds.Float) for x in channels}

    def _camera(self, view: View) -> None:
        camera, prim = view.camera, UsdGeom.Camera.Define(self.stage, self._path("cameras", view.name))
        prim.GetPrim().SetDisplayName(view.name)
        prim.CreateProjectionAttr(UsdGeom.Tokens.perspective)
        prim.CreateHorizontalApertureAttr(FILM)
        prim.CreateVerticalApertureAttr(FILM * camera.height / camera.width)
        prim.CreateFocalLengthAttr(0.5 * FILM / np.tan(0.5 * camera.fov_x))
        prim.CreateClippingRangeAttr(Gf.Vec2f(*clip_planes(self.room.scene, camera)))
        prim.AddTransformOp().Set(_matrix(np.asarray(camera.to_world, np.float64)))

    def _environment(self, environment: EnvironmentMap) -> None:
        """A dome: its map lies as in the specification of OpenEXR, which is how ours does."""
        dome = UsdLux.DomeLight.Define(self.stage, "/room/environment")
        dome.CreateTextureFileAttr(Sdf.AssetPath("./environment.exr"))
        dome.CreateTextureFormatAttr(UsdLux.Tokens.latlong)
        dome.CreateIntensityAttr(1.0)
        pose = np.eye(4)
        pose[:3, :3] = np.asarray(environment.to_world, np.float64)[:3, :3]
        dome.AddTransformOp().Set(_matrix(pose))


def _inputs(mesh: Mesh, material: Material) -> list[tuple[str, str, Any]]:
    """Name, type and value of what a surface has besides base colour and roughness."""
    model = material.model
    inputs: list[tuple[str, str, Any]] = []
    if isinstance(model, DielectricModel):
        inputs += [("metallic", "Float", 0.0), ("opacity", "Float", 0.0), ("ior", "Float", float(model.eta))]
    elif model.is_delta:
        inputs += [("metallic", "Float", 1.0)]
    elif model.is_diffuse:  # no coat: black in one workflow, and an index that reflects nothing for the other
        inputs += [("useSpecularWorkflow", "Int", 1), ("specularColor", "Color3f", (0.0, 0.0, 0.0))]
        inputs += [("ior", "Float", 1.0)]
    elif isinstance(model, PrincipledModel):
        inputs += [("ior", "Float", float(model.eta))]
    if mesh.radiance is not None and mesh.radiance.max() > 0:
        inputs += [("emissiveColor", "Color3f", tuple(mesh.radiance.tolist()))]
    return inputs


def _matrix(pose: Array) -> Any:
    """A transform [4, 4] as USD has it: vectors stand on its left."""
    return Gf.Matrix4d(*pose.T.ravel().tolist())


def _floats(values: Any) -> FloatArray:
    return np.ascontiguousarray(values, np.float32)
