"""The documentation is true: its links lead somewhere, and its script runs."""

import hashlib
import json
import os
import re
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from engine.command_line.main import make_parser
from engine.scene import FORMATS
from engine.scene.mask_formats import MASK_FORMATS
from tests.tiny_scene import write_tiny_scene


def test_links_and_pictures_exist(root: Path) -> None:
    for page in [root / "README.md", *(root / "docs").glob("*.md")]:
        for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
            assert "://" in target or (page.parent / target).exists(), f"{page.name}: {target}"


def test_links_to_headings_lead_to_headings(root: Path) -> None:
    pages = {page: page.read_text(encoding="utf-8") for page in [root / "README.md", *(root / "docs").glob("*.md")]}
    for page, text in pages.items():
        for target, anchor in re.findall(r"\]\(([^)#]*)#([^)]+)\)", text):
            other = pages[(page.parent / target).resolve() if target else page]
            headings = re.findall(r"^#+ (.*)$", other, re.MULTILINE)
            slugs = {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}
            assert anchor in slugs, f"{page.name}: {target}#{anchor}"


def test_the_table_of_contents_names_every_page(root: Path) -> None:
    contents = (root / "docs" / "README.md").read_text(encoding="utf-8")
    pages = {f"({page.name})" for page in (root / "docs").glob("*.md")} - {"(README.md)"}
    assert pages <= {*re.findall(r"\(\S+\)", contents)}


@pytest.mark.parametrize(("page", "formats"), [("captures", FORMATS), ("masks", MASK_FORMATS)])
def test_every_format_is_named(root: Path, page: str, formats: Sequence[Any]) -> None:
    text = (root / "docs" / f"{page}.md").read_text(encoding="utf-8")
    rows = [row.split("|")[1] for row in text.splitlines() if row.startswith("| `")]
    named = {name for row in rows for name in re.findall(r"`([\w-]+)`", row)}
    assert {each.name for each in formats} <= named


def test_every_command_is_named(root: Path) -> None:
    text = (root / "docs" / "command-line.md").read_text(encoding="utf-8")
    commands = re.findall(r"^    ([a-z][\w-]*) ", make_parser().format_help(), re.MULTILINE)
    assert len(commands) > 5 and {*commands} <= {*re.findall(r"`([\w-]+)", text)}


def test_the_script_lifts_a_scene_and_lists_its_objects(root: Path, tmp_path: Path, quick_python: Path) -> None:
    script = re.search(r"```python\n(\"\"\"Lift a scene.*?)```", (root / "docs/scripting.md").read_text(), re.DOTALL)
    scene, lift = write_tiny_scene(tmp_path / "scene", 8, (64, 48)), tmp_path / "lift"
    command = [quick_python, "-c", script[1], str(scene), str(lift), "--steps", "5", "--set", "warm_start=false"]
    process = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert process.returncode == 0, process.stderr
    assert "8 frames" in process.stdout and "chair 1" in process.stdout and "0004 {" in process.stdout


def test_scripts_of_a_researcher_run(root: Path, tmp_path: Path, quick_python: Path) -> None:
    text = (root / "docs/scripting.md").read_text(encoding="utf-8")
    matcher, statistics = re.findall(r"```python\n(\"\"\"(?:Lift with|Statistics).*?)```", text, re.DOTALL)[::-1]
    write_tiny_scene(tmp_path / "scene", 8, (64, 48))
    for name, script in (("matcher.py", matcher), ("statistics.py", statistics)):
        (tmp_path / name).write_text(script)
    for command in (["matcher.py", "scene", "lift", "3"], ["statistics.py", "lift", "table.csv"]):
        process = subprocess.run(
            [quick_python, *command], cwd=tmp_path, capture_output=True, text=True, timeout=300,
            env={**os.environ, "PYTHONPATH": str(root)},
        )  # fmt: skip
        assert process.returncode == 0, process.stderr
    manifest = json.loads((tmp_path / "lift/result/manifest.json").read_text())
    digest = hashlib.sha256((tmp_path / "matcher.py").read_bytes()).hexdigest()[:8]
    assert manifest["versions"]["matcher seen_twice"] == digest and manifest["settings"]["objects"] == "seen_twice"
    assert "chair 1" in (tmp_path / "table.csv").read_text()
