"""What an experiment leaves: results.json and .csv, tables in Markdown, plots, contact sheets, a page brought up to
date."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Mapping
from pathlib import Path

from ..job import JobError, write_atomically
from .plots import write_plots
from .results import csv_text, results_text
from .sheets import write_sheet
from .table import Tables

BEGIN, END = "<!-- tables: made by `python -m engine experiments` -->", "<!-- end of the tables -->"
_SKELETON = """# Experiments

The paper's tables on open data, rivals included; `python -m engine experiments --report docs/experiments.md` brings the
tables up to date. Figures in per cent unless said otherwise, on held-out frames; in the last column what the paper
reports as mIoU / PQ-scene, on other scenes, with other masks and many more steps. LPIPS is not measured: it needs the
weights of a network.
"""


def write_report(
    folder: Path, tables: Tables, *, sheets: Mapping[str, Path] | None = None, page: Path | None = None
) -> None:
    """results.json, results.csv and results.md; with ``sheets`` (caption to the lift's folder), at the end, also the
    plots and sheet.png, and in ``page`` the sections of these scenes. Raises JobError when they cannot be written."""
    try:
        write_atomically(folder / "results.json", results_text(tables.results))
        write_atomically(folder / "results.csv", csv_text(tables.results))
        write_atomically(folder / "results.md", tables.markdown())
        if sheets is None:
            return
        write_sheet(folder / "sheet.png", sheets)
        if not write_plots(folder / "plots", tables):
            print("No plots: matplotlib is not installed (requirements/report.txt).", file=sys.stderr)
    except OSError as error:
        fix = "Make room there, or choose a folder that you may write to with -o."
        raise JobError(f"the results cannot be written ({error.strerror})", folder, fix) from error
    if page is not None:
        _bring_up_to_date(page, tables)


def _bring_up_to_date(page: Path, tables: Tables) -> None:
    try:
        write_atomically(page, with_tables(text_of(page), tables.markdown()))
    except OSError as error:
        fix = "Make room there, or name another page with --report."
        raise JobError(f"the report's page cannot be written ({error.strerror})", page, fix) from error


def refuse_unwritable(page: Path) -> None:
    """Before hours of work: raise JobError when the tables of ``page`` could not be brought up to date at the end."""
    text_of(page)
    folder = next(each for each in page.absolute().parents if each.exists())  # what is missing below it is made
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        raise JobError("the report's page cannot be written", page, "Name a file in a folder of yours.")


def text_of(page: Path) -> str:
    """The text of a page, none of one that is not there. Raises JobError for a file that is no text."""
    try:
        return page.read_text("utf-8") if page.exists() else ""
    except (OSError, UnicodeDecodeError) as error:
        raise JobError("the report's page is no text", page, "Name a Markdown file, or a new one.") from error


def with_tables(page: str, tables: str) -> str:
    """The page with these scenes' sections between its marks, in place of those that stand there of the same scenes; at
    its end where it has no marks."""
    if BEGIN not in page or END not in page:
        page = f"{page or _SKELETON}\n{BEGIN}\n{END}\n"
    before, _, rest = page.partition(BEGIN)
    old, _, after = rest.partition(END)
    sections = {**_sections(old), **_sections(tables)}
    return f"{before}{BEGIN}\n\n{chr(10).join(sections.values())}\n{END}{after}"


def _sections(tables: str) -> dict[str, str]:
    """The sections of a text by the scenes that head them."""
    parts = re.split(r"^(?=### )", tables, flags=re.MULTILINE)
    return {part.partition("\n")[0]: part.rstrip("\n") + "\n" for part in parts if part.startswith("### ")}
