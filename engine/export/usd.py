"""Export a lift as one OpenUSD file: labelled Gaussians, meshes and boxes, and cameras."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Kind, Sdf, Tf, Usd, UsdGeom, UsdSemantics, UsdShade, UsdVol, Vt

from ..job import write_atomically
from ..passes.exr import exact_rate, number_in
from ..passes.layers import linear
from ..posed.classes import VOID
from ..posed.names import unique_names
from ..result_files import Instance
from ..scene import Camera, Frame, watched
from .mesh import MOST_INSTANCES, TEXTURED, Part, parts_of
from .source import FinishedLift
from .splat_files import columns, opacities, unit_turns
from .texture import jpeg_bytes

FOCAL_LENGTH = 24.0  # millimetres, for every camera; the apertures give the angle of view
_TO_USD = np.diag((1.0, -1.0, -1.0, 1.0))  # from OpenCV's camera axes to OpenUSD's (y up, looking along -z)


def export_usd(lift: FinishedLift, output: Path) -> None:
    """Write lift.usdc, in metres, z up, with the pictures of its meshes in pictures/. /Lift is an assembly. In Objects
    and Stuff, each wanted instance and stuff class is a component, named after its lasting number and holds a
    ParticleField3DGaussianSplat and a mesh, and for an instance a box (a guide). Cameras holds the frames' cameras and
    one that moves through them. SemanticsLabelsAPI names "class" and "instance". Raises PlgsError without a surface."""
    parts = parts_of(lift)
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetDefaultPrim(_add_model(stage, "/Lift", Kind.Tokens.assembly))
    for part in watched(parts, lift.part(TEXTURED, 0.95)):
        path = _add_component(stage, lift, part.class_id, part.instance_id, "mesh")
        if part.picture is not None:
            write_atomically(output / _picture(path), jpeg_bytes(part.picture))
        _label(_add_mesh(stage, path, part), lift, part.class_id, part.instance_id)
    splats = lift.splats
    label = splats["class_id"].astype(np.int64) * MOST_INSTANCES + splats["instance_id"]
    for value in watched(np.unique(label).tolist(), lift.part(0.95, 1.0)):
        class_id, instance_id = divmod(value, MOST_INSTANCES)
        path = _add_component(stage, lift, class_id, instance_id, "splats")
        _label(_add_field(stage, path, splats[label == value]), lift, class_id, instance_id)
    for one in lift.listed:
        path = _add_component(stage, lift, one.class_id, one.id, "box")
        _label(_add_box(stage, path, one), lift, one.class_id, one.id)
    is_numbered = _add_cameras(stage, lift.frames)
    rate = exact_rate(lift.scene.fps or 0.0)
    if rate is not None and is_numbered:
        stage.SetTimeCodesPerSecond(float(rate))
        stage.SetFramesPerSecond(float(rate))
    with TemporaryDirectory() as folder:  # OpenUSD exports its binary form only to a path
        stage.GetRootLayer().Export(f"{folder}/lift.usdc")
        write_atomically(output / "lift.usdc", Path(folder, "lift.usdc").read_bytes())


def _add_model(stage: Usd.Stage, path: str, kind: str) -> Usd.Prim:
    prim = UsdGeom.Xform.Define(stage, path).GetPrim()
    Usd.ModelAPI(prim).SetKind(kind)
    return prim


def _add_component(stage: Usd.Stage, lift: FinishedLift, class_id: int, instance_id: int, what: str) -> str:
    """Add the prim of an instance or class, if it does not exist, and return the path for its child, such as its mesh
    (``what``). The last name of this path is unique, too, as other programs show only that."""
    is_object = instance_id and class_id != VOID
    group, name = ("Objects", f"object_{instance_id}") if is_object else ("Stuff", f"class_{class_id}")
    path = f"/Lift/{group}/{name}"
    if not stage.GetPrimAtPath(path):
        _add_model(stage, f"/Lift/{group}", Kind.Tokens.group)
        _label(_add_model(stage, path, Kind.Tokens.component), lift, class_id, instance_id)
    own = f"{path}/{name}_{what}"
    # If every pixel decides on its own, an instance may have several classes.
    return own if not stage.GetPrimAtPath(own) else f"{own}_{class_id}_{instance_id}"


def _label(prim: Usd.Prim, lift: FinishedLift, class_id: int, instance_id: int) -> None:
    """Give the prim of an instance or, if ``instance_id`` is 0, of a class its name and labels."""
    class_name = lift.classes[class_id].name if class_id in lift.classes else ""
    instance = lift.instances.names.get(instance_id, "") if class_id != VOID else ""
    prim.SetDisplayName(instance or class_name or "unlabelled")
    for taxonomy, label in (("class", class_name), ("instance", instance)):
        if label:
            UsdSemantics.LabelsAPI.Apply(prim, taxonomy).CreateLabelsAttr([label])


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
    material = _add_material(stage, path, "" if part.uv is None else _picture(path))
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    return mesh.GetPrim()


def _picture(path: str) -> str:
    """Return the path of a mesh's picture, relative to the stage."""
    return f"pictures/{path.rpartition('/')[2]}.jpg"


def _add_material(stage: Usd.Stage, path: str, picture: str = "") -> UsdShade.Material:
    """Add a matt material with a ``picture`` for the mesh at this path; without one, it shows the display colours."""
    material = UsdShade.Material.Define(stage, f"{path}/Material")
    surface = UsdShade.Shader.Define(stage, f"{path}/Material/Surface")
    reader = UsdShade.Shader.Define(stage, f"{path}/Material/Reader")
    surface.CreateIdAttr("UsdPreviewSurface")
    reader.CreateIdAttr("UsdPrimvarReader_float2" if picture else "UsdPrimvarReader_float3")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st" if picture else "displayColor")
    shown, output = reader, "result"
    if picture:
        shown, output = UsdShade.Shader.Define(stage, f"{path}/Material/Picture"), "rgb"
        shown.CreateIdAttr("UsdUVTexture")
        shown.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(f"./{picture}")
        shown.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set("sRGB")
        for name in ("wrapS", "wrapT"):
            shown.CreateInput(name, Sdf.ValueTypeNames.Token).Set("clamp")
        reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)
        shown.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
    shown.CreateOutput(output, Sdf.ValueTypeNames.Float3)
    colour = surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f)
    colour.ConnectToSource(shown.ConnectableAPI(), output)
    surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(1.0)
    surface.CreateOutput("surface", Sdf.ValueTypeNames.Token)
    material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
    return material


def _add_field(stage: Usd.Stage, path: str, splats: NDArray[np.void]) -> Usd.Prim:
    """Add Gaussians [N], rows of a splat file, as a prim. Their colours are sRGB, as in training and in all viewers."""
    field = UsdVol.ParticleField3DGaussianSplat.Define(stage, path)
    Usd.ColorSpaceAPI.Apply(field.GetPrim()).CreateColorSpaceNameAttr("srgb_rec709_display")
    xyz, scales = columns(splats, "x y z"), np.exp(columns(splats, "scale_0 scale_1 scale_2"))
    field.CreatePositionsAttr(_vectors(xyz))
    field.CreateOrientationsAttr(Vt.QuatfArray.FromNumpy(np.ascontiguousarray(unit_turns(splats)[:, (1, 2, 3, 0)])))
    field.CreateScalesAttr(_vectors(scales))
    field.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(opacities(splats)))
    field.CreateRadianceSphericalHarmonicsDegreeAttr(0)
    field.CreateRadianceSphericalHarmonicsCoefficientsAttr(_vectors(columns(splats, "f_dc_0 f_dc_1 f_dc_2")))
    reach = 3 * scales.max(axis=1, keepdims=True)  # beyond three standard deviations, a Gaussian is nearly invisible
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
    UsdShade.MaterialBindingAPI.Apply(box.GetPrim()).Bind(_add_material(stage, path))
    return box.GetPrim()


def _add_cameras(stage: Usd.Stage, frames: Sequence[Frame]) -> bool:
    """Add a camera for each frame, and one that moves from frame to frame. Returns whether the frames' times are their
    `ascending_numbers`; otherwise they are 1, 2, …"""
    numbers = ascending_numbers([frame.name for frame in frames])
    times = numbers or [*map(float, range(1, len(frames) + 1))]
    if times:
        stage.SetStartTimeCode(min(times))
        stage.SetEndTimeCode(max(times))
    UsdGeom.Scope.Define(stage, "/Lift/Cameras")
    names = unique_names(dict(enumerate(Tf.MakeValidIdentifier(f"camera_{frame.name}") for frame in frames)), "_")
    for number, (frame, time) in enumerate(zip(frames, times, strict=True)):
        still = UsdGeom.Camera.Define(stage, f"/Lift/Cameras/{names[number]}")
        still.GetPrim().SetDisplayName(frame.name)
        _set_camera(still, frame.camera, Usd.TimeCode.Default())
        _set_camera(UsdGeom.Camera.Define(stage, "/Lift/Cameras/moving"), frame.camera, Usd.TimeCode(time))
    return bool(numbers)


def ascending_numbers(names: Sequence[str]) -> list[float]:
    """Return the numbers in frames' names; [] if one has none or, as with fractions of seconds, they do not ascend."""
    numbers = [float(number) for name in names if (number := number_in(name)) is not None]
    ascend = len(numbers) == len(names) and all(one < following for one, following in pairwise(numbers))
    return numbers if ascend else []


def _set_camera(shown: UsdGeom.Camera, camera: Camera, time: Usd.TimeCode) -> None:
    """Set ``shown`` to a camera at a time. Its aperture is the whole picture; its offsets give the principal point."""
    # The apertures of Usd are in tenths of a unit, as the focal length is: only their ratios matter.
    shown.CreateFocalLengthAttr(FOCAL_LENGTH)
    shown.CreateHorizontalApertureAttr().Set(FOCAL_LENGTH * camera.width / camera.fx, time)
    shown.CreateVerticalApertureAttr().Set(FOCAL_LENGTH * camera.height / camera.fy, time)
    shown.CreateHorizontalApertureOffsetAttr().Set(FOCAL_LENGTH * (camera.width / 2 - camera.cx) / camera.fx, time)
    shown.CreateVerticalApertureOffsetAttr().Set(FOCAL_LENGTH * (camera.cy - camera.height / 2) / camera.fy, time)
    shown.CreateClippingRangeAttr(Gf.Vec2f(0.01, 1000.0))
    # OpenUSD's matrices are transposed.
    shown.MakeMatrixXform().Set(Gf.Matrix4d((camera.camera_to_world @ _TO_USD).T.tolist()), time)


def _vectors(rows: Iterable[object] | NDArray[np.floating]) -> Vt.Vec3fArray:
    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(rows, np.float32))
