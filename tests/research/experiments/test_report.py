"""The page and the sheet of an experiment."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from engine.passes.previews import BACKGROUND, GAP, HEADING, MARGIN, TILE_WIDTH
from research.experiments.report import SHEET, with_tables, write_sheet
from research.experiments.table import MEANS


def test_means_stay_the_pages_last_section() -> None:
    page = with_tables("", f"### office\n\n1\n\n{MEANS}\n\n2\n")
    page = with_tables(page, f"### kitchen\n\n3\n\n{MEANS}\n\n4\n")
    assert [line for line in page.splitlines() if line[:3] == "###" or line.isdigit()] == [
        "### office", "1", "### kitchen", "3", MEANS, "4",
    ]  # fmt: skip


def test_a_sheet_has_the_first_row_of_each_lift(tmp_path: Path) -> None:
    height, width = 240, 2 * MARGIN + 2 * TILE_WIDTH + GAP
    for number, colour in enumerate(((0, 0, 250), (0, 250, 0))):
        own = np.full((MARGIN + HEADING + 2 * (height + GAP), width, 3), BACKGROUND[::-1], np.uint8)
        own[MARGIN + HEADING : MARGIN + HEADING + height, MARGIN : MARGIN + TILE_WIDTH] = colour
        own[MARGIN + HEADING + height + GAP :, MARGIN : MARGIN + TILE_WIDTH] = (250, 0, 0)
        path = tmp_path / f"lift{number}" / SHEET
        path.parent.mkdir(parents=True)
        cv2.imwrite(str(path), own)
    lifts = {"one": tmp_path / "lift0", "two": tmp_path / "lift1", "three": tmp_path / "none"}
    write_sheet(tmp_path / "sheet.png", lifts)
    sheet = cv2.imread(str(tmp_path / "sheet.png"))
    assert sheet.shape == (2 * (HEADING + height), width, 3)
    middle = [sheet[HEADING + height // 2 + row * (HEADING + height), MARGIN + 9].tolist() for row in (0, 1)]
    assert middle == [[0, 0, 250], [0, 250, 0]]
    write_sheet(tmp_path / "none.png", {})
    assert not (tmp_path / "none.png").exists()
