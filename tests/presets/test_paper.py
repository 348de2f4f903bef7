"""Each number of the preset "paper" is that of the paper, and of the page that says where it is from."""

import re
from pathlib import Path

import pytest

from engine.presets.options import option_value, preset_options, shown_value
from engine.presets.preset import PRESETS
from engine.train.self_training import pseudo_label_steps
from engine.train.trainer import Trainer

DETAILS, CLOUD = "Implementation Details", "Robust Semantic Anchor Point Discovery"
OF_THE_PAPER = {
    "steps": (30_000, DETAILS),
    "schedule.self_training_every": (5_000 / 30_000, DETAILS),
    "weights.ssim": (0.2, DETAILS),
    "weights.volume": (0.001, DETAILS),
    "weights.semantic": (0.2, DETAILS),
    "weights.instance": (0.2, DETAILS),
    "weights.cluster": (1.0, "Semantic Loss"),
    "weights.depth": (0.0, "Reconstruction Loss"),
    "matching.tau_new": (-0.1, DETAILS),
    "matching.cost": ("IoU+IoM", "Algorithm 1"),
    "objects": ("boxes", "Algorithm 1"),
    "linear_assignment": (True, "Instance Loss"),
    "teach_no_object": (False, "Consistent Instance Mask Generation"),
    "agreement": (1.0, "Consistency-enhanced 2D Mask Generation"),
    "evidence.points": ("pixels", CLOUD),
    "most_pixels": (None, CLOUD),
    "instance_slots": (25, "Datasets"),
    "most_instances": (25, "Datasets"),
    "size": ([640, 640], DETAILS),
    "distance_input": (True, "equation of the decoders"),
    "label_view_input": (True, "equation of the decoders"),
    "labels": ("decoders", "Structured Panoptic-Aware Scene Representation"),
    "one_class_an_object": (False, "Loss Functions"),
    "label_every": (1, "Loss Functions"),
}
WITHOUT_EFFECT = re.compile(r"vote_size|voting\.|segment_voting\.|evidence\.(?!points)")


@pytest.fixture(scope="module")
def rows(root: Path) -> dict[str, tuple[str, str]]:
    text = (root / "docs/paper-and-presets.md").read_text("utf-8")
    found = re.findall(r"^\| `([\w.]+)` \| (\S+) \| (.+) \|$", text, re.M)
    return {name: (value, source) for name, value, source in found}


@pytest.mark.parametrize("name", OF_THE_PAPER)
def test_the_preset_paper_has_the_papers_numbers(name: str, rows: dict[str, tuple[str, str]]) -> None:
    value, source = OF_THE_PAPER[name]
    assert option_value(PRESETS["paper"], name) == value
    assert rows[name][1].startswith(source)


def test_the_docs_list_every_number_of_the_preset_paper(rows: dict[str, tuple[str, str]]) -> None:
    paper, preview = PRESETS["paper"], PRESETS["preview"]
    for name, option in preset_options().items():
        is_listed = option.kind in ("int", "float", "ints") or option_value(paper, name) != option_value(preview, name)
        if is_listed and not WITHOUT_EFFECT.match(name):
            assert rows[name][0] == shown_value(option_value(paper, name)), name
    assert {name for name, (_, source) in rows.items() if not source.startswith("not in the paper")} == {*OF_THE_PAPER}


def test_the_training_schedule_matches_the_paper() -> None:
    """Section "Implementation Details"; growth is Scaffold-GS's, which judges by shares of the steps."""
    paper, schedule = PRESETS["paper"], Trainer.growth_schedule
    every = paper.schedule.self_training_every
    assert pseudo_label_steps(every, paper.steps) == {5_000, 10_000, 15_000, 20_000, 25_000}
    assert (schedule.grow_from * paper.steps, schedule.grow_until * paper.steps) == (1500, 15_000)
    assert paper.for_views(2000) == paper and paper.neighbours > 0
