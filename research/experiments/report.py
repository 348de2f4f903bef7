"""The output of an experiment: results.json and .csv, tables in Markdown, contact sheets, an updated page."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from engine.errors import PlgsError
from engine.job import write_atomically
from engine.passes.previews import first_row
from engine.scene.pixels import image_bytes

from ..results import csv_text, results_text
from .table import MEANS, ON_PAGE, Tables

BEGIN, END = "<!-- tables: made by `python -m research experiments` -->", "<!-- end of the tables -->"
SHEET = Path("result/previews/contact_sheet.png")
_SKELETON = """# Experiments

The paper's tables on open data, baselines included; `python -m research experiments --report docs/experiments.md`
brings the tables up to date. Figures in per cent unless said otherwise, on held-out frames; in the last column what the
paper reports as mIoU / PQ-scene, on other scenes, with other masks and many more steps. LPIPS is not measured: it needs
the weights of a network.
"""


def write_report(
    folder: Path, tables: Tables, *, sheets: Mapping[str, Path] | None = None, page: Path | None = None
) -> None:
    """Write results.json, results.csv and results.md. With ``sheets`` (caption to the lift's folder), which are given
    at the end, also write sheet.png and update the sections of these scenes in ``page``. Raises PlgsError if this
    fails."""
    try:
        write_atomically(folder / "results.json", results_text(tables.results))
        write_atomically(folder / "results.csv", csv_text(tables.results))
        write_atomically(folder / "results.md", tables.markdown())
        if sheets is None:
            return
        write_sheet(folder / "sheet.png", sheets)
    except OSError as error:
        fix = "Make room there, or choose a folder that you may write to with -o."
        raise PlgsError("unwritable", f"the results cannot be written ({error.strerror})", folder, fix) from error
    if page is not None:
        _bring_up_to_date(page, replace(tables, columns=ON_PAGE))


def _bring_up_to_date(page: Path, tables: Tables) -> None:
    try:
        write_atomically(page, with_tables(text_of(page), tables.markdown()))
    except OSError as error:
        fix = "Make room there, or name another page with --report."
        raise PlgsError("unwritable", f"the report's page cannot be written ({error.strerror})", page, fix) from error


def refuse_unwritable(page: Path) -> None:
    """Raise PlgsError, before hours of work, if the tables of ``page`` could not be updated at the end."""
    text_of(page)
    folder = next(each for each in page.absolute().parents if each.exists())  # missing folders below it are made
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        what = "the report's page cannot be written"
        raise PlgsError("unwritable", what, page, "Name a file in a folder that you may write to.")


def text_of(page: Path) -> str:
    """The text of a page, empty where there is no such file. Raises PlgsError for a file that is not text."""
    try:
        return page.read_text("utf-8") if page.exists() else ""
    except (OSError, UnicodeDecodeError) as error:
        what = "the report's page is not a text file"
        raise PlgsError("not-text", what, page, "Name a Markdown file, or a new one.") from error


def with_tables(page: str, tables: str) -> str:
    """The page with the sections of these scenes replaced between its marks; they go to its end if it has no marks."""
    if BEGIN not in page or END not in page:
        page = f"{page or _SKELETON}\n{BEGIN}\n{END}\n"
    before, _, rest = page.partition(BEGIN)
    old, _, after = rest.partition(END)
    sections = {**_sections(old), **_sections(tables)}
    if means := sections.pop(MEANS, ""):
        sections[MEANS] = means  # the last section, after new scenes
    return f"{before}{BEGIN}\n\n{chr(10).join(sections.values())}\n{END}{after}"  # no backslash before Python 3.12


def _sections(tables: str) -> dict[str, str]:
    """The sections of a text, by the scenes in their headings."""
    parts = re.split(r"^(?=### )", tables, flags=re.MULTILINE)
    return {part.partition("\n")[0]: part.rstrip("\n") + "\n" for part in parts if part.startswith("### ")}


def write_sheet(path: Path, lifts: Mapping[str, Path]) -> None:
    """The first held-out frame of each lift (caption to folder): photo, input mask, lifted classes and instances.
    Writes nothing if no lift has a contact sheet. Raises OSError."""
    strips = [first_row(lift / SHEET, caption) for caption, lift in lifts.items() if (lift / SHEET).is_file()]
    if strips:
        width = max(strip.shape[1] for strip in strips)
        wide = [np.pad(strip, ((0, 0), (0, width - strip.shape[1]), (0, 0))) for strip in strips]
        write_atomically(path, image_bytes(np.concatenate(wide)))
