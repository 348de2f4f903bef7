"""Find the poses of photos and films with COLMAP (the package pycolmap), step by step so that it can be stopped. The
result is a COLMAP model beside the photos: ``sparse/0``, where COLMAP itself puts it, with ``made_by.json`` in it. A
reconstruction has no unit of length; measured depth in ``depth``, beside the photos, gives it one."""

from __future__ import annotations

import json
import shutil
import signal
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import PlgsError, lacks_part
from .gates import open_plain
from .job import EventWriter, StopSignal, write_atomically
from .job.lock import FileLock
from .job.own_files import OwnFiles
from .json_file import to_line
from .posed.layout import listed
from .records import record_of, to_json
from .scene.depth import in_metres, read_depth_array
from .scene.files_of_frames import digests_of_files, files_if_any
from .scene.formats import FORMATS
from .scene.formats.colmap_model import MADE_BY, read_model
from .scene.formats.photos import LEAST, Video, is_film, photos_in, sorted_out
from .scene.frame_choice import CANDIDATES, photo_detail
from .scene.made import read_note
from .scene.pixels import decode, write_image


def write_pictures(film: Path, folder: Path, most: int, progress: Callable[[int, int], object]) -> None:
    """Write at most ``most`` pictures of a film as ``folder/images/NNNNNN.jpg``, numbered as in the film, and a
    Record3D film's depth as ``folder/depth/NNNNNN.npy``. ``progress`` is called with (done, total). Raises PlgsError
    for a film that cannot be decoded; OSError."""
    video, encoded = Video(film), encoded_depth(film)
    count = video.count()
    edges = np.linspace(0, count, min(most, count) + 1).astype(int)
    for done, (first, after) in enumerate(zip(edges[:-1], edges[1:], strict=True), start=1):
        numbers = np.unique(np.linspace(first, after - 1, CANDIDATES).round().astype(int))  # short parts repeat some
        whole = {int(number): video.frame(int(number)) for number in numbers}
        pictures = whole if encoded is None else {at: both[:, both.shape[1] // 2 :] for at, both in whole.items()}
        sharpest = max(pictures, key=lambda number: photo_detail(pictures[number]))
        write_image(folder / "images" / f"{sharpest:06d}.jpg", pictures[sharpest])
        if encoded is not None:
            depth = decoded_depth(whole[sharpest][:, : whole[sharpest].shape[1] // 2], *encoded)
            write_atomically(folder / "depth" / f"{sharpest:06d}.npy", partial(_save, depth))
        progress(done, len(edges) - 1)


def _save(values: NDArray[np.float32], path: Path) -> None:
    np.save(path, values)


_RECORD3D, _SEARCHED = b'{"intrinsic', 1 << 20
"""The beginning of the metadata in Record3D's films, and how many bytes at the end of a film are searched for it."""
_COLOURED, _BRIGHT = 96, 96  # least saturation and value of a pixel with depth: others are black, and codecs blur
_LAST = 248  # of 256 hues: what lies beyond the range may be stored as its end, which codecs blur


def encoded_depth(film: Path) -> tuple[float, float] | None:
    """The depths in metres that the hues 0 and 1 stand for in a Record3D "RGBD video" (depth left, picture right), from
    its metadata: ``{"intrinsicMatrix": …, "rangeOfEncodedDepth": [0, 3]}``. None for other films. Raises OSError."""
    with open_plain(film) as file:
        file.seek(max(0, film.stat().st_size - _SEARCHED))
        content = file.read(_SEARCHED)
    start = content.rfind(_RECORD3D)
    text = content[start : content.find(b"}", start) + 1] if start >= 0 else b""
    try:
        low, high = json.loads(text)["rangeOfEncodedDepth"]
        return (float(low), float(high)) if 0.0 <= low < high < 100.0 else None
    except (ValueError, KeyError, TypeError):
        return None


def decoded_depth(shown: NDArray[np.uint8], low: float, high: float) -> NDArray[np.float32]:
    """Return planar depth, float32 [H, W] metres, 0 = none, from a picture uint8 [H, W, 3] that encodes it as hue
    between ``low`` and ``high`` metres."""
    import cv2

    hue, saturation, value = np.moveaxis(cv2.cvtColor(np.ascontiguousarray(shown), cv2.COLOR_RGB2HSV_FULL), -1, 0)
    depth = low + (high - low) * hue.astype(np.float32) / 256  # HSV_FULL has 256 steps of hue
    good = (saturation >= _COLOURED) & (value >= _BRIGHT) & (depth > 0) & (hue < _LAST)
    return np.where(good, depth, np.float32(0))


STAGE = "poses"
_WORK, _LOCK = ".poses-", "lock"
_ALL_PAIRS = 200  # up to this many photos, all pairs are compared; of more, each with its neighbours in order
_NEAR = 20
_POLL_S = 0.1


def colmap(photos: Path) -> Any:
    """Return the package pycolmap. Raises PlgsError if it is not installed."""
    try:
        import pycolmap
    except ImportError as error:
        raise lacks_part("poses of photos are made with the package pycolmap", photos, "colmap") from error
    signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))  # the package's own handler kills at once
    return pycolmap


def map_photos(photos: Path, names: Sequence[str], workplace: Path, events: EventWriter, stop: StopSignal) -> Any:
    """Return the largest reconstruction (pycolmap's) of the photos ``names`` of one camera, or None. Because of
    threading, the same photos may give slightly different poses. Raises PlgsError without pycolmap; Cancelled."""
    pycolmap = colmap(photos)
    pycolmap.logging.minloglevel = 3  # crashes only: other errors are told by what it finds
    pycolmap.set_random_seed(0)
    database, token = workplace / "photos.db", pycolmap.CancellationToken()
    lens = pycolmap.ImageReaderOptions()
    lens.camera_model = "SIMPLE_RADIAL"

    def step(number: int, label: str, work: Callable[[], Any]) -> Any:
        events.stage(STAGE, number, 4, label)
        return _followed(work, token, stop)

    step(2, "Looking for features", lambda: pycolmap.extract_features(
        database, photos, image_names=list(names), camera_mode=pycolmap.CameraMode.SINGLE, reader_options=lens,
        cancellation_token=token,
    ))  # fmt: skip
    if len(names) <= _ALL_PAIRS:
        match = lambda: pycolmap.match_exhaustive(database, cancellation_token=token)  # noqa: E731
    else:
        near = pycolmap.SequentialPairingOptions(overlap=_NEAR)
        match = lambda: pycolmap.match_sequential(  # noqa: E731
            database, pairing_options=near, cancellation_token=token
        )
    step(3, "Comparing photos", match)
    options = pycolmap.IncrementalPipelineOptions(random_seed=0)
    registered = 0

    def on_registered() -> None:
        nonlocal registered
        registered = min(registered + 1, len(names))
        events.progress(STAGE, registered, len(names))

    found = step(4, "Finding poses", lambda: pycolmap.incremental_mapping(
        database, photos, workplace, options=options, next_image_callback=on_registered, cancellation_token=token,
    ))  # fmt: skip
    return max(found.values(), key=lambda model: model.num_reg_images(), default=None)


def _followed(work: Callable[[], Any], token: Any, stop: StopSignal) -> Any:
    """Return the result of ``work``, which runs in its own thread: COLMAP would block the main thread, which must
    receive signals. ``token`` stops the work when ``stop`` says so. Raises the work's error, or Cancelled."""
    with ThreadPoolExecutor(1) as pool:
        found = pool.submit(work)
        try:
            while not found.done():
                stop.check()
                wait([found], _POLL_S)
        except BaseException:
            token.cancel()
            raise
        return found.result()


_LEAST_POINTS = 50
_MOST_SPREAD = 0.2


@dataclass(frozen=True)
class Scale:
    """The unit of a reconstruction in ``metres``, the median over ``points`` points."""

    metres: float
    points: int

    def apply(self, model: Any) -> None:
        """Scale a pycolmap Reconstruction to metres."""
        import pycolmap

        model.transform(pycolmap.Sim3d(self.metres, pycolmap.Rotation3d(), np.zeros((3, 1))))


def metres_per_length(model: Any, depths: Mapping[str, Path]) -> Scale | None:
    """Return the unit of a reconstruction: the median, over the points in all photos, of measured depth divided by
    depth in the reconstruction. None if too few have depth, or their ratios disagree. ``depths`` are files by the
    photos' stems. Raises PlgsError for a bad file."""
    ratios: list[NDArray[np.float64]] = []
    for image in model.images.values():
        path = depths.get(Path(image.name).stem)
        if path is None or not image.has_pose:
            continue
        seen = [point for point in image.points2D if point.has_point3D()]
        if not seen:
            continue
        world = np.array([model.points3D[point.point3D_id].xyz for point in seen])
        pose = image.cam_from_world().matrix()
        z = world @ pose[2, :3] + pose[2, 3]
        values = read_depth_array(path) if path.suffix.lower() == ".npy" else decode(path, as_colour=False)
        depth = in_metres(values)
        height, width = depth.shape
        size = model.cameras[image.camera_id]
        pixels = np.array([point.xy for point in seen]) * [width / size.width, height / size.height]
        columns, rows = np.floor(pixels).astype(np.int64).T
        measured = depth[rows.clip(0, height - 1), columns.clip(0, width - 1)]
        good = (measured > 0.0) & (z > 0.0)
        ratios.append(measured[good] / z[good])
    return _median(np.concatenate([np.empty(0), *ratios]))  # concatenate needs an array


def _median(ratios: NDArray[np.float64]) -> Scale | None:
    if len(ratios) < _LEAST_POINTS:
        return None
    metres = float(np.median(ratios))
    spread = float(np.median(np.abs(ratios / metres - 1.0)))
    return Scale(metres, len(ratios)) if spread <= _MOST_SPREAD else None


FILM_PICTURES = 150  # the largest number of pictures that are taken from a film
_LEAST_SHARE = 0.5
_NO_FILM = "none"
_WITHOUT_DEPTH = (
    "Lengths have no unit, as no measured depth gives it: depth that engine depth (Make Depth) makes is fitted to the "
    "reconstruction's points, whose lengths count as metres until engine scale (Set Scale) sets them"
)


@dataclass(frozen=True)
class Made:
    """The record of poses that were found. ``folder`` is the scene. ``posed`` of ``photos`` pictures have a pose.
    ``scale`` is the reconstruction's unit in metres, None without measured depth. ``files``, ``depth`` and ``film`` are
    digests of the photos, the depth and the film ("none" for photos), "" if unknown. ``asked`` is the number of
    pictures requested from a film, which may have fewer; 0 for photos. ``fps`` is the film's rate."""

    folder: Path = field(metadata={"apart": True})
    posed: int
    photos: int
    points: int
    scale: float | None
    files: str = ""
    depth: str = ""
    film: str = ""
    asked: int = 0
    fps: float | None = None

    @classmethod
    def read(cls, folder: Path) -> Made | None:
        """Read the record of an earlier call in a folder; None without one. Raises PlgsError if it is damaged."""
        path = folder / "sparse" / "0" / MADE_BY
        fix = "Move the folder sparse away, then make the poses again."
        content = read_note(path, fix)
        return None if content is None else record_of(cls, content, path, fix, folder=folder)


def make_poses(source: Path, events: EventWriter, stop: StopSignal, pictures: int | None = None) -> Made:
    """Find the poses of the photos in a folder, or of a film's pictures, and write them beside the photos. A film's
    ``pictures`` (by default at most 150) go into a folder of the film's name. Existing files are never overwritten;
    poses of an earlier call are reused. Raises PlgsError if none are found or the input has changed; Cancelled."""
    made = Made.read(source.with_suffix("") if is_film(source) else source)
    if made is not None:
        _refuse_changed(made, source)
        is_all = made.photos < made.asked  # the film has no more
        if is_film(source) and pictures and (pictures < made.photos or pictures > made.photos and not is_all):
            fix = f"move the folder {made.folder.name} away for others"
            events.warning(f"the poses of {made.photos} pictures that were found before are used: {fix}")
        return made
    refuse_unusable(source)
    colmap(source)  # before minutes of work
    if not is_film(source):
        return _map(source, _photos_in(source), _NO_FILM, asked=0, fps=None, events=events, stop=stop)
    asked = pictures or FILM_PICTURES
    folder, film = source.with_suffix(""), digests_of_files([(source,)])[0]
    own = _begun(folder, film)
    try:
        events.stage(STAGE, 1, 4, "Taking the sharpest pictures of the film")

        def progress(done: int, count: int) -> None:
            stop.check()
            events.progress(STAGE, done, count)

        with own:
            write_pictures(source, folder, asked, progress)
        fps = Video(source).fps()
        made = _map(folder, folder / "images", film, asked=asked, fps=fps, events=events, stop=stop)
        own.complete()
        return made
    except BaseException:
        own.discard()
        raise


def _refuse_changed(made: Made, source: Path) -> None:
    if is_film(source) and made.film not in ("", *digests_of_files([(source,)])):
        fix = f"Move the folder {made.folder.name} away to find this film's poses, or name that folder."
        raise PlgsError("other-photos", "the poses here were found for another film, or for photos", made.folder, fix)
    photos = photos_in(made.folder)
    fix = "Move the folder sparse away to find them again. Without --poses these are used."
    if made.files and (photos is None or made.files != _digest_of(_photos(photos))):
        what = "the photos have changed since their poses were found"
        raise PlgsError("photos-changed", what, made.folder / "sparse", fix)
    depths = [*_depths(made.folder).values()] if made.scale is not None else []
    if depths and made.depth not in ("", _digest_of(depths)):
        what = "the depth has changed since it gave the poses their unit"
        raise PlgsError("depth-changed", what, made.folder / "sparse", fix)


def _digest_of(files: Sequence[Path]) -> str:
    named = [[each.name for each in files], digests_of_files([(each,) for each in files])]
    return sha256(repr(named).encode()).hexdigest()


def _photos(folder: Path) -> list[Path]:
    return [folder / name for name in sorted_out(folder)[0]]


def _depths(folder: Path) -> Mapping[str, Path]:
    """Return the files of measured depth beside photos, by the photos' stems. Raises PlgsError if one stem has two."""
    return files_if_any(folder / "depth", {".png", ".npy"}, "Remove the folder depth.")


def _map(
    folder: Path, photos: Path, film: str, *, asked: int, fps: float | None, events: EventWriter, stop: StopSignal
) -> Made:
    names, others = sorted_out(photos)
    if others:
        what = "show depth or confidence by their names or as grey PNGs of 16 bits"
        events.warning(f"{len(others)} pictures are left out, as they {what}: {listed(others)}.")
    files = _digest_of(_photos(photos))
    with _workplace(folder) as workplace:
        model = map_photos(photos, names, workplace, events, stop)
        if model is None or model.num_reg_images() < max(LEAST, _LEAST_SHARE * len(names)):
            found = 0 if model is None else model.num_reg_images()
            fix = "Take more photos, each showing most of what the one before shows, in good light, without blur."
            raise PlgsError("poses-of-few", f"poses were found for only {found} of {len(names)} photos", photos, fix)
        depths = _depths(folder)
        scale = metres_per_length(model, depths) if depths else None
        if scale is not None:
            scale.apply(model)
        elif depths:
            events.warning("The depth beside the photos does not agree with the reconstruction, and is not used.")
        out = workplace / "sparse" / "0"
        out.mkdir(parents=True)
        model.write(out)
        metres = None if scale is None else scale.metres
        counts = model.num_reg_images(), len(names), model.num_points3D()
        made = Made(folder, *counts, metres, files, _digest_of([*depths.values()]), film, asked, fps)
        (out / MADE_BY).write_bytes(to_line(to_json(made)))
        read_model(out)  # what a lift will read
        if (folder / "sparse").exists():
            raise PlgsError("exists", "the folder for the poses exists already", folder / "sparse", "Move it away.")
        out.parent.rename(folder / "sparse")
    if scale is None:
        events.warning(_WITHOUT_DEPTH + ".")
    return made


@contextmanager
def _workplace(folder: Path) -> Iterator[Path]:
    """Make a temporary folder in ``folder`` for COLMAP's files. Raises PlgsError if another call is at work there."""
    _remove_killed(folder)
    with tempfile.TemporaryDirectory(prefix=_WORK, dir=folder) as place, FileLock(Path(place) / _LOCK):
        yield Path(place)


def _remove_killed(folder: Path) -> None:
    """Remove COLMAP's files of killed calls. Raises PlgsError if another call is at work there; OSError."""
    for lock in folder.glob(f"{_WORK}*/{_LOCK}"):
        with FileLock(lock, wait_s=0.0):
            pass
        shutil.rmtree(lock.parent)


def _begun(folder: Path, film: str) -> OwnFiles:
    """Begin a film's folder, without what a killed call left in it. Raises PlgsError if it holds anything else."""
    _remove_killed(folder)
    own = OwnFiles(folder)
    if own.begun is not None and not own.is_complete:
        own.discard()
    if folder.exists():
        fix = "Make the poses of that folder, or move it away."
        raise PlgsError("exists", "the film's pictures would go into a folder that exists already", folder, fix)
    return own.begin("pictures", {"film": film})


def refuse_unusable(source: Path) -> None:
    """Raise PlgsError unless ``source`` is a folder of photos without poses, or a film that can be opened."""
    if is_film(source):
        Video(source).count()
    else:
        _photos_in(source)


def _photos_in(source: Path) -> Path:
    """Return the folder of a scene's photos. Raises PlgsError if there are no photos, or if they have poses already."""
    photos = photos_in(source) if source.is_dir() else None
    if photos is None:
        what = "this is neither a folder with photos nor a film"
        raise PlgsError("no-photos", what, source, "Name a folder of photos, or an .mp4.")
    for each in FORMATS:
        if each.recognises(source):
            raise PlgsError("has-poses", f"this scene has poses already ({each.name})", source, "Lift it as it is.")
    return photos
