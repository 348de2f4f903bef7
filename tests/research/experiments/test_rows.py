"""The rows as data, each of which can be run, and the scenes named on a command line."""

from pathlib import Path

import pytest

from engine.job import LiftRequest
from engine.metrics.report import INPUT_MASKS
from research.experiments.experiment import SceneToLift, scenes_from
from research.experiments.rows import read_rows
from tests.raises_key import raises_key
from tests.research.experiments.made_up import ROWS
from tests.research.tiny_baseline import registered

with registered():
    FOUND = read_rows()
LETTER = "PLGS from zero features and random decoders"


@pytest.mark.parametrize("row", [row for row in FOUND.rows if row.is_lift], ids=lambda row: row.slug)
def test_every_experiment_row_has_valid_options(row) -> None:
    request = LiftRequest(scene=Path("/room"), options=row.options)
    is_as_the_preset = request.chosen_preset == LiftRequest(scene=Path("/room")).chosen_preset
    assert is_as_the_preset == (not row.options)
    assert row.options or row.name == "ours" or row.masks or row.depth_from


def test_no_two_experiment_rows_are_the_same_lift() -> None:
    lifts = [(tuple(row.options.items()), row.masks, row.depth_from) for row in FOUND.rows if row.is_lift]
    assert len(set(map(repr, lifts))) == len(lifts), "the later one is same_as the other"


def test_every_method_named_in_an_experiment_row_exists() -> None:
    from research.baselines.voxel_vote import VOXEL_VOTE
    from research.baselines.without_a_lift import WITHOUT_A_LIFT

    assert {INPUT_MASKS, VOXEL_VOTE} < set(WITHOUT_A_LIFT)
    assert {row.method for row in FOUND.rows if row.method} <= set(WITHOUT_A_LIFT)


def test_the_experiments_contain_the_papers_ablations() -> None:
    assert {"designs", "cost", "semantics", "instances", "tau", "neighbours", "departures"} <= set(FOUND.tables)
    plgs = FOUND.named("PLGS").options
    paper = LiftRequest(scene=Path("/room"), preset="paper").chosen_preset
    mine = LiftRequest(scene=Path("/room"), options=plgs).chosen_preset
    letter = LiftRequest(scene=Path("/room"), options=FOUND.named(LETTER).options).chosen_preset
    assert letter.warm_start is paper.warm_start is False and letter.seeded_features is paper.seeded_features
    for name in ("objects", "linear_assignment", "weights", "neighbours", "growth", "labels", "matching"):
        assert getattr(mine, name) == getattr(paper, name), name


def test_experiment_rows_and_tables_are_found_by_name() -> None:
    assert [row.name for row in ROWS.chosen(["parts"])] == ["all of it", "without depth", "other masks"]
    assert [row.name for row in ROWS.chosen(["Ours", "without depth"])] == ["ours", "without depth"]
    assert ROWS.chosen([]) == ROWS.rows
    assert ROWS.lift_of(ROWS.named("all of it")).name == "theirs"
    with raises_key("no-row"):
        ROWS.chosen(["without deph"])


@pytest.mark.parametrize(
    ("content", "key"),
    [
        ("", "not-rows tables"),
        ('[tables]\na = "A"\n[[row]]\nname = "x"\ntable = "b"', "not-rows"),
        ('[tables]\na = "A"\n[[row]]\nname = "x"\ntable = "a"\nsame_as = "y"', "not-rows"),
        ('[tables]\na = "A"\n[[row]]\nname = "x"\ntable = "a"\nway = "y"', "not-rows ways"),
        ('[tables]\na = "A"\n[[row]]\nname = "x"\ntable = "a"\n[[row]]\nname = "X"\ntable = "a"', "row-twice"),
        ('[tables]\na = "A"\n[[row]]\nname = "x"\ntable = "a"\nset = { neighbors = 3 }', "no-option neighbours"),
    ],
)
def test_a_file_that_is_not_a_table_of_rows_is_refused(content: str, key: str, tmp_path: Path) -> None:
    path = tmp_path / "rows.toml"
    path.write_text(content)
    with raises_key(key):
        read_rows(path)


def test_the_up_axis_can_follow_a_scenes_path() -> None:
    rooms = Path("rooms").resolve()
    assert scenes_from(["rooms/office", "rooms/kitchen:up=-y"]) == (
        SceneToLift("office", rooms / "office", "z"),
        SceneToLift("kitchen", rooms / "kitchen", "-y"),
    )


def test_a_colon_may_be_part_of_a_scenes_path() -> None:
    (scene,) = scenes_from(["C:rooms:up=y"], ["rooms"])
    assert (scene.folder.name, scene.up) == ("C:rooms", "y")


def test_scenes_of_an_experiment_take_given_names() -> None:
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
def test_bad_scene_arguments_of_an_experiment_are_refused(texts: list[str], names: list[str] | None, key: str) -> None:
    with raises_key(key):
        scenes_from(texts, names)
