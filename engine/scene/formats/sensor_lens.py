"""Lenses in the files that depth cameras' own programs write, where a layout has no better place for a lens.

* Azure Kinect's ``calibration.json``, out of a recording: lengths in shares of the sensor's 4:3 picture, pixel corners
  at whole numbers. Pictures of 16:9 are its middle rows. OpenCV's rational model, p2 before p1.
* Open3D's PinholeCameraIntrinsic with what its readers of recordings add (``camera_intrinsic.json`` of RealSense,
  ``intrinsic.json`` of Azure Kinect): 3x3 column by column, integer pixel centres; ``depth_scale`` steps a metre.
* librealsense's intrinsics: ``fx fy ppx ppy width height model coeffs``, alone or in ``color``; integer pixel centres;
  ``depth_scale`` is the length of a step.

Depth must be registered to colour, as these programs do when asked to.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...errors import PlgsError
from ...json_file import LARGEST_TABLE, parse_json_object, take_number, take_objects
from ...posed.camera import Camera
from ...posed.image_header import read_image_header
from ...posed.layout import read_file, same_shape
from ...posed.matrices import take_numbers
from ..noted import Inferred
from .lens import STRAIGHT, Distortion, fitted, pinhole

_OPEN3D_FILES = ("camera_intrinsic.json", "intrinsic.json")
FILES = (*_OPEN3D_FILES, "calibration.json", "camera_intrinsics.json", "intrinsics.json")
_FIX = "Let the recorder write it again, or remove it and write the lens as the layout has it."
_OPEN3D_FIX = f"Write width, height and intrinsic_matrix of these pictures into {FILES[0]}."
_AZURE_MODELS = ("CALIBRATION_LensDistortionModelBrownConrady", "CALIBRATION_LensDistortionModelRational6KT")
_BENT = "the lens distorts by a model that OpenCV lacks ({}), which is not corrected: straight lines may bend"


@dataclass(frozen=True, eq=False)
class SensorLens:
    """The colour ``camera``, at the origin, that the file ``path`` describes, for pictures of its size.

    ``step`` is the length of a step of depth in metres, None if the file does not say. ``shows_middle`` means that
    pictures of 16:9 are the middle rows of the camera's.
    """

    path: Path
    camera: Camera
    distortion: Distortion = STRAIGHT
    step: float | None = None
    warnings: tuple[str, ...] = ()
    shows_middle: bool = False

    @property
    def inferred(self) -> tuple[Inferred, ...]:
        """What a scene notes whose layout has another place for a lens, or none."""
        what = "the lens is" if self.step is None else "the lens and the unit of depth are"
        taken = f"{what} read from {self.path.name}"
        return (Inferred("lens", taken, "no file of the layout itself says otherwise", is_doubtful=False),)

    def fitting(self, picture: Path) -> Camera:
        """The camera at the size of an image file. Raises PlgsError when it is for pictures of another shape."""
        width, height = read_image_header(picture).size
        if not (self.shows_middle and same_shape((width, height), (16, 9))):
            return fitted(self.camera, picture, f"Give pictures of that camera, or write theirs into {self.path.name}.")
        rows = round(height * 4 / 3)
        first = (rows - height) // 2
        return self.camera.resized(width, rows).of_rows(first, first + height)


def find_sensor_lens(place: Path) -> SensorLens | None:
    """The lens that a sensor's file in the folder ``place`` says; None without such a file. Raises PlgsError."""
    for path in (place / name for name in FILES):
        if path.is_file():
            # Azure Kinect's own text ends with a zero byte.
            found = _lens(parse_json_object(read_file(path, LARGEST_TABLE).rstrip(b"\0"), path), path)
            if found is not None:
                return found
    return None


def _lens(entry: dict[str, Any], path: Path) -> SensorLens | None:
    """None for a file of another kind: people call many things ``calibration.json``. Raises PlgsError."""
    if isinstance(entry.get("CalibrationInformation"), dict):
        return _azure(entry["CalibrationInformation"], path)
    own = next((entry[key] for key in ("color", "rgb", "intrinsics") if isinstance(entry.get(key), dict)), entry)
    if "ppx" in own:
        return _realsense(own, _step(entry, path), path)
    if "intrinsic_matrix" not in entry and path.name not in _OPEN3D_FILES:
        return None
    return SensorLens(path, open3d_lens(entry, path), step=_step(entry, path))


def open3d_lens(entry: dict[str, Any], path: Path) -> Camera:
    """A camera at the origin from Open3D's PinholeCameraIntrinsic. Raises PlgsError."""
    width, height = (take_number(entry, key, "the intrinsics", path) for key in ("width", "height"))
    K = take_numbers(entry, "intrinsic_matrix", "the intrinsics", path, 9)
    return pinhole(width, height, K[0], K[4], K[6] + 0.5, K[7] + 0.5, path=path, fix=_OPEN3D_FIX)


def _step(entry: dict[str, Any], path: Path) -> float | None:
    """Metres a step. Open3D writes steps a metre, which are more than one, librealsense metres. Raises PlgsError."""
    if "depth_scale" not in entry:
        return None
    scale = take_number(entry, "depth_scale", "the file", path)
    if scale <= 0.0:
        raise PlgsError("depth_scale is not above 0", path, _FIX)
    return 1.0 / scale if scale > 1.0 else scale


def _realsense(entry: dict[str, Any], step: float | None, path: Path) -> SensorLens:
    width, height, fx, fy, cx, cy = (
        take_number(entry, key, "the lens", path) for key in ("width", "height", "fx", "fy", "ppx", "ppy")
    )
    camera = pinhole(width, height, fx, fy, cx + 0.5, cy + 0.5, path=path, fix=_FIX)
    bent = Distortion("brown", tuple(take_numbers(entry, "coeffs", "the lens", path, 5)) if "coeffs" in entry else ())
    if not bent.bends:
        return SensorLens(path, camera, step=step)
    model = re.sub("[^a-z]", "", str(entry.get("model", "")).lower()).removeprefix("distortion")
    if model == "brownconrady":
        return SensorLens(path, camera, bent, step)
    return SensorLens(path, camera, step=step, warnings=(_BENT.format(model[:40] or "unnamed"),))


def _azure(entry: dict[str, Any], path: Path) -> SensorLens:
    cameras = take_objects(entry, "Cameras", "CalibrationInformation", path)
    colour = [each for each in cameras if str(each.get("Purpose", "")).endswith("PhotoVideo")]
    lens = colour[0].get("Intrinsics") if colour else None
    if not isinstance(lens, dict) or lens.get("ModelType") not in _AZURE_MODELS:
        raise PlgsError("the colour camera of an Azure Kinect is missing, or of another model", path, _FIX)
    width, height = (take_number(colour[0], key, "the colour camera", path) for key in ("SensorWidth", "SensorHeight"))
    # cx cy fx fy k1 k2 k3 k4 k5 k6, the distortion's own centre, which is 0 0, p2 p1
    cx, cy, fx, fy, k1, k2, *rest, x, y, p2, p1 = take_numbers(lens, "ModelParameters", "the lens", path, 14).tolist()
    if x or y:
        raise PlgsError("the lens distorts around a centre of its own, which is not known here", path, _FIX)
    camera = pinhole(width, height, fx * width, fy * height, cx * width, cy * height, path=path, fix=_FIX)
    return SensorLens(path, camera, Distortion("brown", (k1, k2, p1, p2, *rest)), shows_middle=True)
