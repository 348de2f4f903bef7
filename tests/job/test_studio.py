"""A studio's defaults: read from its file, used where an option is not given, and refused if anything is wrong."""

import argparse
from pathlib import Path

import pytest

from engine.job.request import add_lift_options, request_from
from engine.job.studio import VARIABLE, StudioDefaults, filled_in, studio_defaults
from tests.raises_key import raises_key

TEXT = 'preset = "own.toml"\nmasks = "masks/{scene}"\nnames = "{shot}_{camera}"\ndevice = "auto"\nmemory = 12\n'


def test_studio_defaults_fill_in_options_that_are_not_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "plgs.toml").write_text(TEXT)
    (tmp_path / "own.toml").write_text('preset = "standard"\nsteps = 7\n')
    (tmp_path / "room.v2").mkdir()
    parser = argparse.ArgumentParser()
    parser.add_argument("scene", type=Path)
    add_lift_options(parser)
    room = str(tmp_path / "room.v2")
    before = request_from(filled_in(parser.parse_args([room])))
    assert (before.preset, before.masks, capsys.readouterr().err) == ("preview", None, "")
    monkeypatch.setenv(VARIABLE, str(tmp_path / "plgs.toml"))
    found = request_from(filled_in(parser.parse_args([room])))
    assert (found.preset, found.chosen_preset.steps, found.device) == ("standard", 7, "auto")
    assert found.masks == tmp_path / "masks" / "room.v2"
    assert capsys.readouterr().err.startswith(f"{tmp_path / 'plgs.toml'} sets preset {tmp_path / 'own.toml'}, masks ")
    given = request_from(filled_in(parser.parse_args([room, "--preset", "paper", "--device", "cpu"])))
    assert (given.preset, given.device) == ("paper", "cpu")
    assert capsys.readouterr().err.count(",") == 0, "masks alone"
    batch = filled_in(argparse.Namespace(scenes=[], masks=None, memory=0.0))
    assert batch.memory == 12.0 and batch.masks == tmp_path / "masks" / "{scene}"
    assert studio_defaults().names == "{shot}_{camera}" and studio_defaults({}) == StudioDefaults()


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ('quality = "high"', "unknown-field"),
        ('device = "gpu"', "wrong-type"),
        ("memory = 0", "wrong-type"),
        ('preset = "fast"', "bad-record"),
        ('names = "{shot}_{lens}"', "bad-record"),
        ('masks = "{scene}/{shot}"', "bad-record"),
        ("preset = ", "not-toml"),
        (None, "unreadable"),
    ],
)
def test_a_wrong_file_of_studio_defaults_is_refused(text: str | None, key: str, tmp_path: Path) -> None:
    if text is not None:
        (tmp_path / "plgs.toml").write_text(text)
    with raises_key(f"{key} plgs.toml"):
        studio_defaults({VARIABLE: str(tmp_path / "plgs.toml")})
