"""Formats are told apart by the names of their files; what is not clear is refused with a line."""

from pathlib import Path

import pytest

from engine.errors import ErrorCode, PlgsError
from engine.posed.plain_folders import NAME
from engine.scene import FORMATS, open_scene
from engine.scene.formats.capture import frame_names
from engine.scene.mask_formats import MASK_FORMATS
from engine.scene_source import MASK_FORMAT_NAMES, SCENE_FORMAT_NAMES
from tests.scene.formats import test_colmap, test_nerfstudio
from tests.scene.formats.room import check_colours
from tests.scene.refusing import refuses


@pytest.mark.parametrize("odd", ["", ".", "/", "//", "\\", "..", "./."])
def test_a_frame_whose_path_has_no_file_name_gets_a_name(odd: str) -> None:
    """Random search found it in a COLMAP model: an image whose name was cut off."""
    names = frame_names(["a/0001.png", odd])
    assert names[0] == "0001" and names[1] and "/" not in names[1]
    assert all(frame_names([odd, odd, "a/0001.png", "b/0001.png"]))


def test_each_format_has_its_own_name_and_says_what_it_looks_for() -> None:
    for formats, told in ((FORMATS, SCENE_FORMAT_NAMES), (MASK_FORMATS, MASK_FORMAT_NAMES)):
        names = [each.name for each in formats]
        assert len({*names}) == len(names) and names == [each.name for each in told]
        assert all(each.label and each.looks_for for each in told)
    assert FORMATS[0].name == NAME and (len(FORMATS), len(MASK_FORMATS)) == (17, 12)
    readme = (Path(__file__).parents[3] / "README.md").read_text()
    assert "Seventeen layouts are recognised" in readme and "Twelve kinds of masks are recognised" in readme


def test_a_folder_that_matches_two_formats_requires_a_choice(tmp_path: Path) -> None:
    test_colmap.write_text(test_nerfstudio.write_scene(tmp_path))
    refuses("several-formats nerfstudio colmap --format", tmp_path)
    for name in ("nerfstudio", "colmap"):
        scene = open_scene(tmp_path, scene_format=name)
        assert scene.format == name
        check_colours(scene)


@pytest.mark.parametrize(
    ("files", "told", "code"),
    [
        (["Scaniverse 2026-01-02.spz"], "models-only", False),
        (["scan.obj", "scan.mtl", "1.jpg", "2.jpg", "3.jpg"], "models-only scan.obj", False),
        (["1.ply", "2.ply"], "models-only", False),
        (["mesh.ply", "images/1.jpg", "images/2.jpg", "images/3.jpg"], "no-poses --poses", True),
        (["rgb/1.png", "rgb/2.png", "rgb/3.png", "depths/1.png", "poses/1.txt"], "loose-folders pose/NAME.txt", False),
        (["rgb/1.png", "rgb/2.png", "rgb/3.png", "poses.txt"], "loose-folders --poses", False),
        (["1_pose.txt", "1_depth.png", "1_rgb.png", "2_rgb.png", "3_rgb.png"], "loose-folders docs/captures.md", False),
        (["rtabmap_poses.txt", "rgb/1.jpg", "rgb/2.jpg", "rgb/3.jpg"], "rtabmap groundtruth.txt", False),
    ],
)
def test_a_folder_without_a_scene_suggests_an_export(tmp_path: Path, files: list[str], told: str, code: bool) -> None:
    for name in files:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    assert (refuses(told, tmp_path).code is ErrorCode.NO_POSES) is code


def test_a_folder_of_several_scenes_is_refused_with_their_names(tmp_path: Path) -> None:
    (tmp_path / "notes").mkdir()
    test_nerfstudio.write_scene(tmp_path / "room_2")
    refuses("inner-scenes room_2", tmp_path)


def test_a_lift_named_as_a_scene_is_told_to_be_one(tmp_path: Path) -> None:
    (tmp_path / "request.json").write_text("{}")
    refuses("lift-as-scene", tmp_path)


@pytest.mark.parametrize(("name", "told"), [("scan.zip", "archive"), ("Scaniverse.ply", "models-only")])
def test_a_file_that_is_no_scene_is_refused(tmp_path: Path, name: str, told: str) -> None:
    (tmp_path / name).write_bytes(b"")
    refuses(told, tmp_path / name)


def test_photos_in_an_unsupported_file_format_are_refused(tmp_path: Path) -> None:
    (tmp_path / "IMG_1.HEIC").touch()
    refuses("photos-of-another-kind IMG_1.HEIC", tmp_path)


@pytest.mark.parametrize("name", [each.name for each in FORMATS])
@pytest.mark.parametrize("place", ["empty", "file.txt"])
def test_a_format_option_that_does_not_fit_gives_a_one_line_error(tmp_path: Path, name: str, place: str) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "file.txt").write_text("1 2 3\n")
    with pytest.raises(PlgsError) as caught:
        open_scene(tmp_path / place, scene_format=name)
    assert "\n" not in str(caught.value) and caught.value.fix
