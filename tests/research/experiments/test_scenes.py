"""The scenes named on a command line."""

from __future__ import annotations

from pathlib import Path

import pytest

from research.experiments.experiment import SceneToLift, scenes_from
from tests.raises_key import raises_key


def test_scene_text_can_name_its_axis() -> None:
    rooms = Path("rooms").resolve()
    assert scenes_from(["rooms/office", "rooms/kitchen:up=-y"]) == (
        SceneToLift("office", rooms / "office", "z"),
        SceneToLift("kitchen", rooms / "kitchen", "-y"),
    )


def test_a_pattern_stands_for_the_folders_it_matches(tmp_path: Path) -> None:
    for name in ("scene2", "scene1", "other"):
        (tmp_path / name).mkdir()
    (tmp_path / "scene3.txt").touch()
    found = scenes_from([f"{tmp_path}/scene*:up=y", "rooms/office"])
    assert [(scene.name, scene.up) for scene in found] == [("scene1", "y"), ("scene2", "y"), ("office", "z")]
    with raises_key("no-match"):
        scenes_from([f"{tmp_path}/nothing*"])


def test_a_colon_may_be_part_of_a_path() -> None:
    (scene,) = scenes_from(["C:rooms:up=y"], ["rooms"])
    assert (scene.folder.name, scene.up) == ("C:rooms", "y")


def test_scenes_take_given_names() -> None:
    scenes = scenes_from(["one/room", "two/room:up=y"], ["first", "second"])
    assert [(scene.name, scene.up) for scene in scenes] == [("first", "z"), ("second", "y")]


@pytest.mark.parametrize(
    ("texts", "names", "key"),
    [
        (["room:up=x"], None, "not-axis"),
        (["room:up="], None, "not-axis"),
        (["one/room", "two/Room"], None, "names-clash Room"),
        (["one", "two"], ["a"], "unequal-counts"),
        (["one"], ["a/b"], "scene-unnamable a/b"),
        (["one"], [".."], "scene-unnamable"),
        (["one"], ["a|b"], "scene-unnamable"),
        (["/"], None, "scene-unnamable"),
        ([""], None, "not-scene"),
    ],
)
def test_bad_scene_texts_are_refused(texts: list[str], names: list[str] | None, key: str) -> None:
    with raises_key(key):
        scenes_from(texts, names)
