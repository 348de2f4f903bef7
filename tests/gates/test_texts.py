"""Texts of other people, fit for a terminal, a panel, a log and a table."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from engine.errors import PlgsError
from engine.gates import markdown_cell, one_line, plot_label, printable, table_cell

MARKS = [*range(0x00, 0x09), *range(0x0B, 0x20), 0x7F, *range(0x80, 0xA0), 0x200E, 0x200F, *range(0x2028, 0x202F),
         *range(0x2066, 0x206A), 0xFEFF]  # fmt: skip


@pytest.mark.parametrize("code", MARKS, ids=hex)
def test_terminal_control_characters_are_removed(code: int) -> None:
    assert printable(f"a{chr(code)}b") == one_line(f"a{chr(code)}b") == "a?b"


def test_letters_of_all_scripts_are_kept() -> None:
    assert one_line("Stuhl, 椅子, כיסא, كرسي, 🪑") == "Stuhl, 椅子, כיסא, كرسي, 🪑"
    assert one_line("two\nlines") == "two lines"


@pytest.mark.parametrize("text", ["=1+1", "+1", "-1", "@SUM(A1)"])
def test_no_table_cell_is_a_formula(text: str) -> None:
    assert table_cell(text) == "'" + text
    assert table_cell("chair") == "chair" and table_cell(-1.5) == -1.5


@pytest.mark.parametrize("fit", [table_cell, markdown_cell, plot_label])
def test_tables_and_plots_have_no_control_characters_either(fit: Callable[[str], object]) -> None:
    assert fit("a\u202eb\nc") == "a?b c"


def test_a_markdown_cell_cannot_end_early_or_contain_tags() -> None:
    assert markdown_cell("a|b\\|<img src=x>") == "a\\|b\\\\\\|&lt;img src=x>"


def test_a_plot_label_is_not_a_formula(tmp_path: Path) -> None:
    pyplot = pytest.importorskip("matplotlib.pyplot", reason="matplotlib is not installed: requirements/test.txt")
    figure, axes = pyplot.subplots()
    axes.set_title(plot_label(r"a $\nothing{$ b"))
    figure.savefig(tmp_path / "plot.svg")
    pyplot.close(figure)


def test_an_error_of_many_lines_is_shortened() -> None:
    said = "Error(s) in loading:\n\t" + "\n\t".join(f"size mismatch for layer.{i}" for i in range(100))
    error = PlgsError(f"the model cannot be read ({said})", "model", "Lift again.")
    assert error.what.isprintable() and len(error.what) == 600 and "Error(s) in loading: size mismatch" in error.what
    assert str(error) == f"{error.what}: model. Lift again."
