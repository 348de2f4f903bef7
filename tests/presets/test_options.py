"""Options of a preset by name: what is read, what is refused, and with which advice."""

import argparse
from dataclasses import dataclass
from pathlib import Path

import pytest

from engine.job import LiftRequest
from engine.job.request import add_lift_options, chosen_options, request_from
from engine.presets.options import (
    changed_options,
    checked_options,
    option_value,
    parsed_options,
    preset_options,
    preset_text,
    read_preset_file,
    shown_options,
    with_options,
)
from engine.presets.preset import PRESETS, Preset
from engine.train.trainer import Trainer
from tests.raises_key import raises_key


def request_of(*arguments: str) -> LiftRequest:
    parser = argparse.ArgumentParser()
    parser.add_argument("scene", type=Path)
    add_lift_options(parser)
    return request_from(parser.parse_args(["/room", *arguments]))


def test_options_typed_as_name_equals_value_are_parsed() -> None:
    texts = ["objects=boxes", "weights.depth=0", "growth.least_visits=none", "size=64x48", "fill_holes=no"]
    assert parsed_options([*texts, "neighbours=3", "neighbours=4"]) == {
        "objects": "boxes",
        "weights.depth": 0.0,
        "growth.least_visits": None,
        "size": [64, 48],
        "fill_holes": False,
        "neighbours": 4,
    }


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("neighbors=4", "no-option neighbours"),
        ("depth=0", "no-option weights.depth"),
        ("objects=bokses", "bad-value boxes"),
        ("neighbours=2.5", "bad-value 64"),
        ("neighbours=-1", "bad-value 64"),
        ("matching.tau_new=nan", "bad-value -2"),
        ("fill_holes=2", "bad-value true false"),
        ("voxel_size=none", "bad-value 0.001"),
        ("size=320x", "bad-value"),
        ("size=8,48", "bad-value 16"),
        ("size_within=320x240", "no-option size"),
        ("rates.feature=1,1", "no-option"),
        ("steps=" + "9" * 400, "bad-value"),
        ("weights.depth=1e999", "bad-value"),
        ("weights.depth", "no-option"),
        ("", "no-option"),
    ],
)
def test_an_unknown_option_suggests_the_closest_name(text: str, key: str) -> None:
    with raises_key(key):
        parsed_options([text])


@pytest.mark.parametrize("base", PRESETS)
def test_a_printed_preset_is_read_back(base: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(preset_text(base, {"weights.depth": 0.25}))
    read, options = read_preset_file(path)
    assert read == base and changed_options(PRESETS[base], options) == {"weights.depth": 0.25}
    assert parsed_options(shown_options(options)) == options


@pytest.mark.parametrize(
    ("content", "key"),
    [
        ("steps = ", "not-toml"),
        ("steps = 3", "preset-base draft preview standard paper"),
        ('preset = "preview"\n[weights]\ndept = 1', "no-option weights.depth"),
        ('preset = "preview"\nobjects = "box"', "bad-value boxes"),
        ('preset = "preview"\nsteps = 2026-11-22', "bad-value"),
    ],
)
def test_a_bad_preset_file_is_named(content: str, key: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(content)
    with raises_key(f"{key} {path}"):
        read_preset_file(path)


def test_a_preset_file_and_options_make_the_same_request(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text('preset = "standard"\nsteps = 9\nsize = [64, 48]\nobjects = "boxes"\nneighbours = 2')
    request = request_of("--preset", str(path), "--set", "neighbours=4", "--set", "fill_holes=true")
    own = {"steps": 9, "size": [64, 48], "neighbours": 4, "objects": "boxes"}
    assert (request.preset, request.options) == ("standard", own), "what is as in the preset is left out"
    assert request_of("--preset", str(path), "--steps", "7", "--frames", "all").options == own | {
        "steps": 7, "neighbours": 2, "frames": 0,
    }  # fmt: skip
    assert request_of("--set", "weights.depth=0").options == {"weights.depth": 0.0}
    assert request_of("--set", "steps=7", "--size", "64x48").options == {"steps": 7, "size": [64, 48]}


def test_the_options_steps_and_steps_a_view_are_both_kept(tmp_path: Path) -> None:
    both = request_of("--set", "steps=600", "--set", "steps_a_view=5")
    assert both.options == {"steps": 600, "steps_a_view": 5.0}
    path = tmp_path / "mine.toml"
    path.write_text(preset_text("preview", both.options))
    assert request_of("--preset", str(path)) == both
    exactly = request_of("--preset", str(path), "--steps", "700")
    assert exactly.options == {"steps": 700}, "what a command line says wins over a file"
    path.write_text(preset_text("preview", {}))
    assert request_of("--preset", str(path)) == request_of()


def test_setting_an_option_to_its_preset_value_undoes_an_earlier_change() -> None:
    earlier = LiftRequest(Path("/scene"), options={"steps": 600, "size": [100, 100], "frames": 7, "voxel_size": 0.1})
    texts = ["steps=500", "steps_a_view=5", "size=200,200", "frames=400", "voxel_size=0.06"]
    preset, options = chosen_options(None, parsed_options(texts), earlier)
    assert preset == "preview" and changed_options(PRESETS[preset], options) == {}


@pytest.mark.parametrize("name", PRESETS)
def test_setting_a_presets_own_values_changes_nothing(name: str) -> None:
    values = {option: option_value(PRESETS[name], option) for option in preset_options()}
    assert checked_options(values) == values, "no preset has a value that is refused"
    assert with_options(PRESETS[name], values) == PRESETS[name] and changed_options(PRESETS[name], values) == {}


def test_scenes_with_many_views_train_more_steps() -> None:
    for preset in (PRESETS["preview"], PRESETS["standard"]):
        assert preset.for_views(3) == preset, "few views are seen often anyway"
        many = preset.for_views(2000)
        assert many.steps == 2000 * preset.steps_a_view > preset.steps
        assert many.growth.least_visits is not None
        # In the half of the lift in which anchors grow, a view comes up more than twice.
        assert many.steps * Trainer.growth_schedule.grow_until > 2 * 2000
    assert PRESETS["paper"].for_views(2000) == PRESETS["paper"]


def test_a_lift_request_keeps_its_changed_options() -> None:
    options = {"steps": 7, "size": [100, 50], "weights.depth": 0, "warm_start": False, "growth.least_visits": None}
    chosen = LiftRequest(scene=Path("/room"), preset="standard", options=options).chosen_preset
    assert (chosen.steps, chosen.size, chosen.weights.depth, chosen.warm_start) == (7, (100, 50), 0.0, False)
    assert chosen.growth.least_visits is None and chosen.weights.ssim == PRESETS["standard"].weights.ssim
    assert chosen.for_views(1000).steps == 7, "steps are exactly that many"
    both = LiftRequest(Path("/scene"), options={"steps": 600, "steps_a_view": 5}).chosen_preset
    assert both.for_views(200).steps == 1000


@dataclass(frozen=True)
class _Further(Preset):
    colour: bool = False


def test_scripts_can_register_options(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, preset in list(PRESETS.items()):
        monkeypatch.setitem(PRESETS, name, _Further(**vars(preset)))
    assert option_value(with_options(PRESETS["paper"], checked_options({"colour": True})), "colour") is True
    assert (PRESETS["paper"].steps, list(preset_options())[-1]) == (30_000, "colour")
