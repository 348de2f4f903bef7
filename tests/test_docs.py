"""The documentation is true: its links lead somewhere, and it names what there is. tests/doors/ does what it says."""

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from engine.command_line.main import make_parser
from engine.presets.preset import PRESETS
from engine.scene import FORMATS
from engine.scene.mask_formats import MASK_FORMATS


def test_links_and_pictures_of_the_docs_exist(root: Path) -> None:
    for page in [root / "README.md", *(root / "docs").glob("*.md")]:
        for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
            assert "://" in target or (page.parent / target).exists(), f"{page.name}: {target}"


def test_links_to_headings_of_the_docs_lead_to_headings(root: Path) -> None:
    pages = {page: page.read_text(encoding="utf-8") for page in [root / "README.md", *(root / "docs").glob("*.md")]}
    for page, text in pages.items():
        for target, anchor in re.findall(r"\]\(([^)#]*)#([^)]+)\)", text):
            other = pages[(page.parent / target).resolve() if target else page]
            headings = re.findall(r"^#+ (.*)$", other, re.MULTILINE)
            slugs = {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}
            assert anchor in slugs, f"{page.name}: {target}#{anchor}"


def test_the_docs_table_of_contents_names_every_page(root: Path) -> None:
    contents = (root / "docs" / "README.md").read_text(encoding="utf-8")
    pages = {f"({page.name})" for page in (root / "docs").glob("*.md")} - {"(README.md)"}
    assert pages <= {*re.findall(r"\(\S+\)", contents)}


@pytest.mark.parametrize(("page", "formats"), [("captures", FORMATS), ("masks", MASK_FORMATS)])
def test_the_docs_name_every_format(root: Path, page: str, formats: Sequence[Any]) -> None:
    text = (root / "docs" / f"{page}.md").read_text(encoding="utf-8")
    rows = [row.split("|")[1] for row in text.splitlines() if row.startswith("| `")]
    named = {name for row in rows for name in re.findall(r"`([\w-]+)`", row)}
    assert {each.name for each in formats} <= named


def test_the_makefile_and_the_farm_offer_every_preset(root: Path) -> None:
    assert f"[PRESET={'|'.join(PRESETS)}]" in (root / "Makefile").read_text(encoding="utf-8")
    assert f"choices: {json.dumps([*PRESETS])}" in (root / "farm" / "plgs.js").read_text(encoding="utf-8")


def test_the_docs_name_every_command(root: Path) -> None:
    text = (root / "docs" / "command-line.md").read_text(encoding="utf-8")
    commands = re.findall(r"^    ([a-z][\w-]*) ", make_parser().format_help(), re.MULTILINE)
    assert len(commands) > 5 and {*commands} <= {*re.findall(r"`([\w-]+)", text)}
