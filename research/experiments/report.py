"""Write the output of an experiment: results.json and .csv, and tables in Markdown."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from engine.errors import PlgsError
from engine.job import write_atomically

from ..results import csv_text, results_text
from .table import ON_PAGE, Tables


def write_report(folder: Path, tables: Tables) -> None:
    """Write results.json, results.csv and results.md. Raises PlgsError if this fails."""
    try:
        write_atomically(folder / "results.json", results_text(tables.results))
        write_atomically(folder / "results.csv", csv_text(tables.results))
        write_atomically(folder / "results.md", replace(tables, columns=ON_PAGE).markdown())
    except OSError as error:
        fix = "Make room there, or choose a folder that you may write to with -o."
        raise PlgsError("unwritable", f"the results cannot be written ({error.strerror})", folder, fix) from error
