"""From photos to a COLMAP model beside them: ``sparse/0``, where COLMAP itself puts it, and ``made_by.json`` in it.

A reconstruction has no unit of length. Where measured depth lies beside the photos, in ``depth``, it gives the unit.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

from ..errors import PlgsError
from ..job import EventWriter, StopSignal
from ..json_file import Json, read_object, to_line
from ..posed.layout import listed
from ..scene.files_of_frames import digests_of_files, files_if_any
from ..scene.formats import FORMATS
from ..scene.formats.colmap_model import MADE_BY, read_model
from ..scene.formats.photos import LEAST, is_film, photos_in, sorted_out
from .film import write_pictures
from .mapping import colmap, map_photos
from .scale import metres_per_length

STAGE = "poses"
FILM_PICTURES = 150
"""The largest number of pictures that are taken from a film."""
_LEAST_SHARE = 0.5
_NO_FILM = "none"
_WITHOUT_DEPTH = (
    "Lengths have no unit, and there is no depth: a lift needs a network's depth maps with --depth FOLDER, which are "
    "fitted to the reconstruction's points; its metres are then the reconstruction's lengths"
)


@dataclass(frozen=True)
class Made:
    """``folder``: the scene. ``posed`` of ``photos`` pictures have a pose. ``scale`` is the metres per length of the
    reconstruction, None without measured depth. ``files``, ``depth`` and ``film`` are digests of the photos, of the
    depth and of the film, empty where an earlier version made the poses; ``film`` is "none" for photos.
    ``asked`` is how many pictures a film was to give, which may have fewer; 0 for photos, and where it is not known.
    """

    folder: Path
    posed: int
    photos: int
    points: int
    scale: float | None
    files: str = ""
    depth: str = ""
    film: str = ""
    asked: int = 0

    def to_json(self) -> dict[str, Json]:
        """What is kept beside the model."""
        return {name: value for name, value in asdict(self).items() if name != "folder"}

    @classmethod
    def read(cls, folder: Path) -> Made | None:
        """What an earlier call made of a folder; None where it made nothing. Raises PlgsError."""
        path = folder / "sparse" / "0" / MADE_BY
        if not path.is_file():
            return None
        fix = "Move the folder sparse away, then make the poses again."
        data: Mapping[str, Any] = read_object(path, fix)
        try:
            counts = int(data["posed"]), int(data["photos"]), int(data["points"])
            files, depth, film = (str(data.get(name, "")) for name in ("files", "depth", "film"))
            return cls(folder, *counts, data["scale"], files, depth, film, int(data.get("asked", 0)))
        except (KeyError, TypeError, ValueError) as error:
            raise PlgsError("this is not a record of made poses", path, fix) from error


def make_poses(place: Path, events: EventWriter, stop: StopSignal, pictures: int | None = None) -> Made:
    """Find the poses of the photos in a folder, or of a film's pictures, and write them beside the photos.

    A film's ``pictures``, at most 150 where nothing is asked, go into a folder of the film's name. Existing files are
    never overwritten; poses that an earlier call made are used. Raises PlgsError, also where what they were found by
    has changed since; OSError; Cancelled.
    """
    made = Made.read(place.with_suffix("") if is_film(place) else place)
    if made is not None:
        _refuse_changed(made, place)
        is_all = made.photos < made.asked  # the film has no more
        if is_film(place) and pictures and (pictures < made.photos or pictures > made.photos and not is_all):
            fix = f"move the folder {made.folder.name} away for others"
            events.warning(f"the poses of {made.photos} pictures that were found before are used: {fix}")
        return made
    colmap(place)  # before minutes of work
    asked = (pictures or FILM_PICTURES) if is_film(place) else 0
    folder, photos = _photos_of(place, events, stop, asked)
    try:
        film = digests_of_files([(place,)])[0] if is_film(place) else _NO_FILM
        return _map(folder, photos, film, asked, events, stop)
    except BaseException:
        if is_film(place):  # its pictures, which this call wrote
            shutil.rmtree(folder, ignore_errors=True)
        raise


def _refuse_changed(made: Made, place: Path) -> None:
    """Raise PlgsError where the photos, the measured depth that gave the unit, or the film are others. OSError."""
    if is_film(place) and made.film not in ("", *digests_of_files([(place,)])):
        fix = f"Move the folder {made.folder.name} away to find this film's poses, or name that folder."
        raise PlgsError("the poses here were found for another film, or for photos", made.folder, fix)
    photos = photos_in(made.folder)
    fix = "Move the folder sparse away to find them again. Without --poses these are used."
    if made.files and (photos is None or made.files != _digest_of(_photos(photos))):
        raise PlgsError("the photos have changed since their poses were found", made.folder / "sparse", fix)
    depths = [*_depths(made.folder).values()] if made.scale is not None else []
    if depths and made.depth not in ("", _digest_of(depths)):
        what = "the depth has changed since it gave the poses their unit"
        raise PlgsError(what, made.folder / "sparse", fix)


def _digest_of(files: Sequence[Path]) -> str:
    """Of files and their names."""
    named = [[each.name for each in files], digests_of_files([(each,) for each in files])]
    return sha256(repr(named).encode()).hexdigest()


def _photos(folder: Path) -> list[Path]:
    return [folder / name for name in sorted_out(folder)[0]]


def _depths(folder: Path) -> Mapping[str, Path]:
    """The measured depth beside photos, by their stems. Raises PlgsError, OSError."""
    return files_if_any(folder / "depth", {".png", ".npy"}, "Remove the folder depth.")


def _map(folder: Path, photos: Path, film: str, asked: int, events: EventWriter, stop: StopSignal) -> Made:
    names, others = sorted_out(photos)
    if others:
        what = "show depth or confidence by their names or as grey PNGs of 16 bits"
        events.warning(f"{len(others)} pictures are left out, as they {what}: {listed(others)}.")
    files = _digest_of(_photos(photos))
    with tempfile.TemporaryDirectory(prefix=".poses-", dir=folder) as workplace:
        model = map_photos(photos, names, Path(workplace), events, stop)
        if model is None or model.num_reg_images() < max(LEAST, _LEAST_SHARE * len(names)):
            found = 0 if model is None else model.num_reg_images()
            fix = "Take more photos, each showing most of what the one before shows, in good light, without blur."
            raise PlgsError(f"poses were found for only {found} of {len(names)} photos", photos, fix)
        depths = _depths(folder)
        scale = metres_per_length(model, depths) if depths else None
        if scale is not None:
            scale.apply(model)
        elif depths:
            events.warning("The depth beside the photos does not agree with the reconstruction, and is not used.")
        out = Path(workplace) / "sparse" / "0"
        out.mkdir(parents=True)
        model.write(out)
        metres = None if scale is None else scale.metres
        counts = model.num_reg_images(), len(names), model.num_points3D()
        made = Made(folder, *counts, metres, files, _digest_of([*depths.values()]), film, asked)
        (out / MADE_BY).write_bytes(to_line(made.to_json()))
        read_model(out)  # what a lift will read
        if (folder / "sparse").exists():
            raise PlgsError("there is a folder of this name already", folder / "sparse", "Move it away.")
        out.parent.rename(folder / "sparse")
    if scale is None:
        events.warning(_WITHOUT_DEPTH + ".")
    return made


def _photos_of(place: Path, events: EventWriter, stop: StopSignal, pictures: int) -> tuple[Path, Path]:
    """The scene's folder, and the folder of its photos. Raises PlgsError where there are none, or poses already."""
    if is_film(place):
        folder = place.with_suffix("")
        if folder.exists():
            fix = "Make the poses of that folder, or move it away."
            raise PlgsError("the film's pictures would go into a folder that exists already", folder, fix)
        part = folder.with_name(f".{folder.name}.part")
        shutil.rmtree(part, ignore_errors=True)

        def progress(done: int, count: int) -> None:
            stop.check()
            events.progress(STAGE, done, count)

        events.stage(STAGE, 1, 4, "Taking the sharpest pictures of the film")
        try:
            write_pictures(place, part / "images", pictures, progress)
            part.rename(folder)
        finally:
            shutil.rmtree(part, ignore_errors=True)
        return folder, folder / "images"
    photos = photos_in(place) if place.is_dir() else None
    if photos is None:
        raise PlgsError("there are no photos here, nor is this a film", place, "Name a folder of photos, or an .mp4.")
    for each in FORMATS:
        if each.recognises(place):
            raise PlgsError(f"this scene has poses already ({each.name})", place, "Lift it as it is.")
    return place, photos
