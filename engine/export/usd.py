"""A lift as one OpenUSD file: labelled Gaussians, meshes and boxes, and cameras."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdSemantics, UsdShade, UsdVol, Vt

from ..job import write_atomically
from ..passes.layers import linear
from ..posed.classes import VOID
from ..posed.names import unique_names
from ..result_files import Instance
from ..scene import Camera
from .mesh import MOST_INSTANCES, Part, parts_of
from .source import FinishedLift
from .splat_files import columns, opacities, unit_turns
from .texture import jpeg_bytes

FOCAL_LENGTH = 24.0
"""Millimetres, for every camera; the apertures give the angle of view."""
_TO_USD = np.diag((1.0, -1.0, -1.0, 1.0))
"""From OpenCV's camera axes to OpenUSD's (y up, looking along -z)."""


def export_usd(lift: FinishedLift, output: Path) -> None:
    """lift.usdc, in metres, z up, with the pictures of its meshes in pictures/: a ParticleField3DGaussianSplat, a mesh
    and a box (a guide) for each wanted instance, the first two for each wanted stuff class, and the frames' cameras.

    SemanticsLabelsAPI names the "class" of each of them and, where there is one, the "instance". Raises as
    ``mesh.parts_of``.
    """
    parts = parts_of(lift)
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/Lift").GetPrim())
    for path, part in zip(_paths(stage, "Meshes", (part.name for part in parts)), parts, strict=True):
        if part.picture is not None:
            write_atomically(output / _picture(path), jpeg_bytes(part.picture))
        name = lift.instances.names.get(part.instance_id, "")
        _label(_add_mesh(stage, path, part), part.name, part.class_name, name)
    _add_splats(stage, lift)
    for path, one in zip(_paths(stage, "Boxes", (one.name for one in lift.listed)), lift.listed, strict=True):
        _label(_add_box(stage, path, one), one.name, one.class_name, one.name)
    paths = _paths(stage, "Cameras", (f"camera_{frame.name}" for frame in lift.frames))
    for path, frame in zip(paths, lift.frames, strict=True):
        _add_camera(stage, path, frame.name, frame.camera)
    with TemporaryDirectory() as folder:
        stage.GetRootLayer().Export(f"{folder}/lift.usdc")
        write_atomically(output / "lift.usdc", Path(folder, "lift.usdc").read_bytes())


def _label(prim: Usd.Prim, name: str, class_name: str, instance: str) -> None:
    prim.SetDisplayName(name)
    for taxonomy, label in (("class", class_name), ("instance", instance)):
        if label:
            UsdSemantics.LabelsAPI.Apply(prim, taxonomy).CreateLabelsAttr([label])


def _paths(stage: Usd.Stage, scope: str, names: Iterable[str]) -> Iterable[str]:
    """The paths of prims of these names."""
    valid = {number: Tf.MakeValidIdentifier(name) for number, name in enumerate(names, start=1)}
    if valid:
        UsdGeom.Scope.Define(stage, f"/Lift/{scope}")
    return [f"/Lift/{scope}/{name}" for name in unique_names(valid, "_").values()]


def _add_mesh(stage: Usd.Stage, path: str, part: Part) -> Usd.Prim:
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr(_vectors(part.xyz))
    mesh.CreateNormalsAttr(_vectors(part.normal))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray(len(part.triangles), 3))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(part.triangles.reshape(-1).astype(np.int32)))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateDoubleSidedAttr(True)
    mesh.CreateExtentAttr(_vectors([part.xyz.min(axis=0), part.xyz.max(axis=0)]))
    mesh.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex).Set(_vectors(linear(part.rgb / 255)))
    if part.uv is not None:
        st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, "faceVarying")
        st.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(part.uv.reshape(-1, 2) * (1, -1) + (0, 1), np.float32)))
        UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(_add_material(stage, path))
    return mesh.GetPrim()


def _picture(path: str) -> str:
    """The file of a mesh's picture, relative to the stage."""
    return f"pictures/{path.rpartition('/')[2]}.jpg"


def _add_material(stage: Usd.Stage, path: str) -> UsdShade.Material:
    """A matt material with the picture of the mesh at this path."""
    material = UsdShade.Material.Define(stage, f"{path}/Material")
    surface, picture, uv = (
        UsdShade.Shader.Define(stage, f"{path}/Material/{name}") for name in ("Surface", "Picture", "Place")
    )
    for shader, kind in ((surface, "UsdPreviewSurface"), (picture, "UsdUVTexture"), (uv, "UsdPrimvarReader_float2")):
        shader.CreateIdAttr(kind)
    uv.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
    picture.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(f"./{_picture(path)}")
    picture.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set("sRGB")
    picture.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(uv.ConnectableAPI(), "result")
    colour = surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f)
    colour.ConnectToSource(picture.ConnectableAPI(), "rgb")
    surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(1.0)
    material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
    return material


def _add_splats(stage: Usd.Stage, lift: FinishedLift) -> None:
    """A field for each instance and stuff class, and one for the unlabelled rest."""
    splats = lift.splats
    label = splats["class_id"].astype(np.int64) * MOST_INSTANCES + splats["instance_id"]
    names_of = {}
    for value in np.unique(label).tolist():
        class_id, instance_id = divmod(value, MOST_INSTANCES)
        class_name = lift.classes[class_id].name if class_id in lift.classes else ""
        instance = lift.instances.names.get(instance_id, "") if class_id != VOID else ""
        names_of[value] = (instance or class_name or "unlabelled", class_name, instance)
    for path, value in zip(_paths(stage, "Splats", (name for name, *_ in names_of.values())), names_of, strict=True):
        _label(_add_field(stage, path, splats[label == value]), *names_of[value])


def _add_field(stage: Usd.Stage, path: str, splats: NDArray[np.void]) -> Usd.Prim:
    """Gaussians by the columns of a splat file. Their colours are sRGB, as in training and in all viewers."""
    field = UsdVol.ParticleField3DGaussianSplat.Define(stage, path)
    Usd.ColorSpaceAPI.Apply(field.GetPrim()).CreateColorSpaceNameAttr("srgb_rec709_display")
    xyz, scales = columns(splats, "x y z"), np.exp(columns(splats, "scale_0 scale_1 scale_2"))
    field.CreatePositionsAttr(_vectors(xyz))
    field.CreateOrientationsAttr(Vt.QuatfArray.FromNumpy(np.ascontiguousarray(unit_turns(splats)[:, (1, 2, 3, 0)])))
    field.CreateScalesAttr(_vectors(scales))
    field.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(opacities(splats)))
    field.CreateRadianceSphericalHarmonicsDegreeAttr(0)
    field.CreateRadianceSphericalHarmonicsCoefficientsAttr(_vectors(columns(splats, "f_dc_0 f_dc_1 f_dc_2")))
    reach = 3 * scales.max(axis=1, keepdims=True)
    field.CreateExtentAttr(_vectors([(xyz - reach).min(axis=0), (xyz + reach).max(axis=0)]))
    return field.GetPrim()


def _add_box(stage: Usd.Stage, path: str, one: Instance) -> Usd.Prim:
    box = UsdGeom.Cube.Define(stage, path)
    box.CreateSizeAttr(1.0)
    box.AddTranslateOp().Set(Gf.Vec3d(*one.centre))
    box.AddOrientOp().Set(Gf.Quatf(*one.rotation))
    box.AddScaleOp().Set(Gf.Vec3f(*one.size))
    box.CreatePurposeAttr(UsdGeom.Tokens.guide)
    box.CreateDisplayColorAttr(_vectors([linear(np.array(one.colour) / 255)]))
    return box.GetPrim()


def _add_camera(stage: Usd.Stage, path: str, name: str, camera: Camera) -> None:
    """A camera whose aperture is the whole picture; its offsets carry the principal point."""
    shown = UsdGeom.Camera.Define(stage, path)
    shown.GetPrim().SetDisplayName(name)
    # The apertures of Usd are in tenths of a unit, as the focal length is: only their ratios matter.
    shown.CreateFocalLengthAttr(FOCAL_LENGTH)
    shown.CreateHorizontalApertureAttr(FOCAL_LENGTH * camera.width / camera.fx)
    shown.CreateVerticalApertureAttr(FOCAL_LENGTH * camera.height / camera.fy)
    shown.CreateHorizontalApertureOffsetAttr(FOCAL_LENGTH * (camera.width / 2 - camera.cx) / camera.fx)
    shown.CreateVerticalApertureOffsetAttr(FOCAL_LENGTH * (camera.cy - camera.height / 2) / camera.fy)
    shown.CreateClippingRangeAttr(Gf.Vec2f(0.01, 1000.0))
    shown.AddTransformOp().Set(Gf.Matrix4d((camera.camera_to_world @ _TO_USD).T.tolist()))  # it has rows for columns


def _vectors(rows: Iterable[object] | NDArray[np.floating]) -> Vt.Vec3fArray:
    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(rows, np.float32))
