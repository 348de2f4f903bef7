"""EXR round trip, and what Blender's compositor makes of the file."""

import math
import sys
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from engine import __version__
from engine.job import FURTHER_LAYERS
from engine.passes.baked_view import BakedView, ShownInstances, bake_view
from engine.passes.exr import ShownFrame, further_layers, is_own, read_exr, write_exr
from engine.passes.layers import decide
from tests.passes.views import CLASSES, EDGE, LEFT, NAMES, NOTHING, RIGHT, made_rendering

OpenEXR = pytest.importorskip("OpenEXR")


def write_layers(path: Path) -> Path:
    write_exr(path, _baked(), layers=FURTHER_LAYERS, shown=ShownFrame(fps=24 / 1.001))
    return path


def _baked() -> BakedView:
    rendering = made_rendering()
    return bake_view([rendering], rendering.camera, CLASSES, ShownInstances(NAMES))


def test_a_written_exr_is_read_back_with_all_layers(tmp_path: Path) -> None:
    written, read = decide(made_rendering(), CLASSES), read_exr(write_layers(tmp_path / "a.exr"))
    for name, expected in written._asdict().items():
        if name == "combined":
            expected = expected.astype(np.float16)
        assert (expected == getattr(read, name)).all(), name
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr"]


def test_pass_files_are_single_part_zip_exrs_with_float_ids(tmp_path: Path) -> None:
    with OpenEXR.File(str(write_layers(tmp_path / "a.exr")), separate_channels=True) as file:
        assert len(file.parts) == 1
        assert file.header()["compression"] == OpenEXR.ZIP_COMPRESSION
        names = set(file.channels())
        half = {name for name, channel in file.channels().items() if channel.pixels.dtype == np.float16}
        assert {channel.pixels.dtype for channel in file.channels().values()} == {np.dtype(t) for t in ("f2", "f4")}
    assert {name.split(".")[1] for name in half - {*"RGBA"}} == {"Combined", "Confidence", "Entropy", "Normal"}
    assert {"PLGS.Combined.R", "PLGS.Combined.A", "PLGS.Depth.V", "PLGS.Semantic.V", "PLGS.Instance.V"} < names
    assert {"PLGS.Confidence.V", "PLGS.Entropy.V", "CryptoInstance00.r", "CryptoClass02.a"} < names
    assert {f"PLGS.{layer}.{axis}" for layer in ("Normal", "Position") for axis in "XYZ"} < names
    assert {f"PLGS.Vector.{axis}" for axis in "XYZW"} < names
    assert len(names) == 4 + 9 + 6 + 4 + 12 + 12


def channels_of(path: Path) -> dict[str, np.ndarray]:
    """By OpenImageIO if it is there, else by OpenEXR."""
    try:
        import OpenImageIO
    except ImportError:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            return {name: channel.pixels for name, channel in file.channels().items()}
    file = OpenImageIO.ImageInput.open(str(path))
    return dict(zip(file.spec().channelnames, np.moveaxis(file.read_image("float"), -1, 0), strict=True))


@pytest.mark.skipif(sys.platform != "linux", reason="a folder where root, too, can write nothing")
def test_a_system_error_while_writing_an_exr_names_the_file() -> None:
    with pytest.raises(OSError) as refused:
        write_exr(Path("/proc/0001.exr"), _baked())
    assert refused.value.filename == "/proc/0001.exr"


def test_an_exr_with_inexact_ids_or_without_passes_is_refused(tmp_path: Path) -> None:
    view = _baked()
    layers = view.layers._replace(instance=np.full((6, 8), 1 << 24, np.int32))
    with pytest.raises(ValueError, match="exact"):
        write_exr(tmp_path / "a.exr", replace(view, layers=layers))
    with OpenEXR.File({}, {"Y": np.zeros((2, 2), np.float32)}) as file:
        file.write(str(tmp_path / "b.exr"))
    with pytest.raises(ValueError, match="not a pass of a lift"):
        read_exr(tmp_path / "b.exr")
    with pytest.raises(FileNotFoundError):
        read_exr(tmp_path / "c.exr")


@pytest.mark.parametrize(
    ("name", "shown", "noted"),
    [
        ("a.1001", ShownFrame(), {"imageCounter": 1001}),
        ("a.0001", ShownFrame(fps=24.0), {"imageCounter": 1, "timeCode": (0, 0, 0, 1)}),
        ("a", ShownFrame(90000, 23.976), {"imageCounter": 90000, "timeCode": (1, 2, 30, 0)}),
        ("a.-003", ShownFrame(fps=24.0), {"imageCounter": -3}),
        ("wide", ShownFrame(fps=24.0), {}),
        ("wide", ShownFrame(display=(-1, 2, 4, 3)), {}),
    ],
)
def test_exr_headers_hold_frame_and_camera(name: str, shown: ShownFrame, noted: dict[str, Any], tmp_path: Path) -> None:
    view, path = _baked(), tmp_path / f"{name}.exr"
    camera = replace(view.camera, fy=view.camera.fy * 1.5)
    write_exr(path, replace(view, camera=camera), shown=shown)
    assert is_own(path) and further_layers(path) == set() and read_exr(path).depth.shape == camera.size[::-1]
    with OpenEXR.File(str(path)) as file:
        header = dict(file.header())
    code = header.pop("timeCode", None)
    found = {key: header[key] for key in ("imageCounter",) if key in header}
    found |= {"timeCode": (code.hours, code.minutes, code.seconds, code.frame)} if code is not None else {}
    assert found == noted and header["pixelAspectRatio"] == pytest.approx(1.5)
    points = camera.unproject(np.full((camera.height, camera.width), 2.0, np.float32)).reshape(-1, 3)
    rows = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    seen = rows @ header["worldToCamera"]
    np.testing.assert_allclose(seen[:, 2:], [[2.0, 1.0]] * len(points), atol=1e-5)  # looks along +z
    assert (np.sign(seen[0, :2]) == [-1, 1]).all(), "x to the right and y up, from the upper left pixel"
    left, top, width, height = shown.display or (0, 0, *camera.size)
    ndc = rows @ header["worldToNDC"]
    pixels = np.stack(np.meshgrid(np.arange(8), np.arange(6)), -1).reshape(-1, 2) + 0.5
    expected = (pixels - [left, top]) / [width, height]
    np.testing.assert_allclose(ndc[:, :2] / ndc[:, 3:], expected, atol=1e-5)
    size = np.array([width / camera.fx, height / camera.fy])
    assert header["screenWindowWidth"] == pytest.approx(size[0])
    on_plane = (camera.world_to_camera @ np.append(points[0], 1.0))[:2] / 2.0 * [1, -1]
    corner = header["screenWindowCenter"] + size / 2 * [-1, 1]
    per_pixel = size / [width, height]
    np.testing.assert_allclose(on_plane, corner + per_pixel * ([0.5 - left, top - 0.5]), atol=1e-6)
    assert [corner.tolist() for corner in header["displayWindow"]] == [[0, 0], [width - 1, height - 1]]
    assert [corner.tolist() for corner in header["dataWindow"]] == [[-left, -top], [7 - left, 5 - top]]
    if shown.display is None:
        assert read_exr(path).depth.shape == (6, 8)


@pytest.mark.parametrize(
    ("fps", "expected"),
    [
        (24.0, (24, 1)), (23.976, (24000, 1001)), (24 / np.float32(1.001), (24000, 1001)), (29.97, (30000, 1001)),
        (12.5, (25, 2)), (24 / np.float32(0.96), (25, 1)), (1e9, None), (1e-9, None), (-24.0, None), (math.nan, None),
    ],
)  # fmt: skip
def test_the_exr_header_has_the_exact_frame_rate(fps: float, expected: tuple[int, int] | None, tmp_path: Path) -> None:
    rated, plain = tmp_path / "rated.exr", tmp_path / "plain.exr"
    write_exr(rated, _baked(), shown=ShownFrame(fps=float(fps)))
    write_exr(plain, _baked())
    with OpenEXR.File(str(rated)) as file, OpenEXR.File(str(plain)) as other:
        header, without = dict(file.header()), dict(other.header())
    assert header.pop("framesPerSecond", None) == (None if expected is None else Fraction(*expected))
    assert repr(header) == repr(without)
    one, two = channels_of(rated), channels_of(plain)
    assert one.keys() == two.keys() and all(np.array_equal(one[name], two[name]) for name in one)


def test_openimageio_reads_the_same_values_from_pass_files(tmp_path: Path) -> None:
    import OpenImageIO as oiio

    path = write_layers(tmp_path / "a.exr")
    read = oiio.ImageInput.open(str(path))
    spec, pixels = read.spec(), read.read_image("float")
    read.close()
    with OpenEXR.File(str(path), separate_channels=True) as file:
        written = {name: channel.pixels.copy() for name, channel in file.channels().items()}
        header = dict(file.header())
    assert spec.channelnames[:4] == ("R", "G", "B", "A") and set(spec.channelnames) == set(written)
    assert spec.getattribute("Software") == f"PLGS {__version__}" and spec.getattribute("screenWindowWidth") > 0
    assert np.allclose(spec.getattribute("chromaticities"), (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329))
    assert spec.getattribute("colorInteropID") == "lin_rec709_scene"
    assert spec.getattribute("framesPerSecond") == (24000, 1001) and header["framesPerSecond"] == Fraction(24000, 1001)
    assert spec.getattribute("PixelAspectRatio") == 1.0 and len(spec.getattribute("worldToCamera")) == 16
    for column, name in enumerate(spec.channelnames):
        assert np.array_equal(pixels[..., column], written[name]), name
    manifests = [key for key in header if key.startswith("cryptomatte/") and key.endswith("/manifest")]
    assert len(manifests) == 2 and all(spec.getattribute(key) == header[key] for key in manifests)
    copy = oiio.ImageOutput.create(str(tmp_path / "b.exr"))  # as a tool that passes the file on
    assert copy.open(str(tmp_path / "b.exr"), spec) and copy.write_image(pixels)
    copy.close()
    assert is_own(path) and not is_own(tmp_path / "b.exr")
    one, other = read_exr(path), read_exr(tmp_path / "b.exr")
    assert all((own == others).all() for own, others in zip(one, other, strict=True))


def test_blender_reads_ids_and_mattes_of_pass_files(tmp_path: Path) -> None:
    bpy = pytest.importorskip("bpy")
    image = bpy.data.images.load(str(write_layers(tmp_path / "a.exr")))
    image.size[:]  # loads the file
    scene = bpy.data.scenes.new("passes")
    tree = _compositor(bpy, scene)
    source = tree.nodes.new("CompositorNodeImage")
    source.image, source.layer = image, "PLGS"
    outputs = {socket.name: socket for socket in source.outputs if socket.enabled}
    wanted = {"instance": outputs["Instance"], "semantic": outputs["Semantic"], "colour": outputs["Combined"]}
    wanted |= {"depth": outputs["Depth"], "confidence": outputs["Confidence"], "entropy": outputs["Entropy"]}
    for name in ("Normal", "Position"):
        split = tree.nodes.new("ShaderNodeSeparateXYZ" if bpy.app.version >= (4, 5, 0) else "CompositorNodeSeparateXYZ")
        tree.links.new(outputs[name], split.inputs[0])
        wanted |= {f"{name} {axis}": split.outputs[axis] for axis in "XYZ"}
    for stem, layer, name in (
        ("matte_1", "CryptoInstance", "chair 1"),
        ("matte_2", "CryptoInstance", "chair 2"),
        ("matte_sofa", "CryptoClass", "sofa long"),
    ):
        node = tree.nodes.new("CompositorNodeCryptomatteV2")
        node.source, node.image, node.layer_name, node.matte_id = "IMAGE", image, layer, name
        wanted[stem] = node.outputs["Matte"]
    for stem, socket in wanted.items():
        _save(bpy, tree, tmp_path, stem, socket)
    with bpy.context.temp_override(scene=scene):
        bpy.ops.render.render()
    seen = {stem: _pixels(tmp_path / f"{stem}_0001.exr") for stem in wanted}
    bpy.data.scenes.remove(scene)
    bpy.data.images.remove(image)

    layers = decide(made_rendering(), CLASSES)
    assert (seen["instance"][..., 0] == layers.instance).all()
    assert (seen["semantic"][..., 0] == layers.semantic).all()
    assert seen["colour"][0, 0] == pytest.approx(layers.combined[0, 0], abs=1e-4)
    assert seen["depth"][..., 0] == pytest.approx(layers.depth)
    assert seen["confidence"][..., 0] == pytest.approx(layers.confidence)
    assert seen["entropy"][..., 0] == pytest.approx(layers.entropy)
    view = _baked()
    for name, planes in (("Normal", view.surface.normal), ("Position", view.surface.position)):
        for axis, plane in zip("XYZ", planes, strict=True):
            stored = plane.astype(np.float16) if name == "Normal" else plane
            assert np.array_equal(seen[f"{name} {axis}"][..., 0], stored), (name, axis)
    assert np.array_equal(seen["colour"][..., 3], layers.combined[..., 3].astype(np.float16))  # the true coverage
    matte_1, matte_2, sofa = (seen[name][..., 0] for name in ("matte_1", "matte_2", "matte_sofa"))
    assert matte_1[LEFT] == pytest.approx(1.0, abs=1e-6)
    assert matte_1[EDGE] == pytest.approx(0.6, abs=6e-4)
    assert not matte_1[RIGHT].any() and not matte_1[NOTHING].any()
    assert matte_2[RIGHT] == pytest.approx(1.0, abs=1e-6)
    assert sofa[RIGHT] == pytest.approx(0.25, abs=1e-6)


def _compositor(bpy, scene):  # type: ignore[no-untyped-def]
    """An empty compositor tree of the scene, exact, in Blender 4 and 5."""
    scene.frame_current = 1
    scene.render.use_compositing = True
    scene.render.compositor_device, scene.render.compositor_precision = "CPU", "FULL"
    if bpy.app.version >= (5, 0, 0):
        scene.compositing_node_group = bpy.data.node_groups.new("passes", "CompositorNodeTree")
        return scene.compositing_node_group
    scene.use_nodes = True
    scene.node_tree.nodes.clear()
    return scene.node_tree


def _save(bpy, tree, folder: Path, stem: str, socket) -> None:  # type: ignore[no-untyped-def]
    node = tree.nodes.new("CompositorNodeOutputFile")
    if bpy.app.version >= (5, 0, 0):
        node.directory, node.file_name, node.format.media_type = str(folder), f"{stem}_####", "IMAGE"
        node.file_output_items.clear()
        node.file_output_items.new("RGBA" if socket.type == "RGBA" else "FLOAT", "")
    else:
        node.base_path, node.file_slots[0].path = str(folder), f"{stem}_####"
    node.format.file_format, node.format.color_depth = "OPEN_EXR", "32"
    tree.links.new(socket, node.inputs[0])


def _pixels(path: Path) -> np.ndarray:
    """All channels of an EXR, [H, W, C], in the order R G B A where it has those, else its only one."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        found = {name: channel.pixels for name, channel in file.channels().items()}
    names = [name for name in "RGBA" if name in found] or sorted(found)
    return np.stack([found[name] for name in names], axis=-1)
