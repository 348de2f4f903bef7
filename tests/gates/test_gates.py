"""What comes from outside: files, and texts."""

import os
import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from engine import gates
from engine.errors import PlgsError

pytestmark = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no FIFOs here")


def listening(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(path))


SPECIAL: dict[str, Callable[[Path], object]] = {
    "fifo": os.mkfifo,
    "device": lambda path: path.symlink_to("/dev/zero"),
    "folder": Path.mkdir,
    "socket": listening,
}


@pytest.mark.parametrize("make", SPECIAL.values(), ids=SPECIAL)
def test_fifos_and_devices_are_not_read_as_files(
    make: Callable[[Path], object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # a socket's path is short
    path = Path("special")
    make(path)
    for open_it in (gates.open_plain, lambda path: gates.read_plain(path, 100), gates.open_to_append):
        with pytest.raises(OSError):
            open_it(path)


def test_links_are_followed_only_where_it_is_allowed(tmp_path: Path) -> None:
    target, link = tmp_path / "target", tmp_path / "link"
    target.write_bytes(b"theirs")
    link.symlink_to(target)
    assert gates.read_plain(link, 100) == b"theirs"
    for open_it in (lambda path: gates.open_plain(path, follow_link=False), gates.open_to_append):
        with pytest.raises(OSError, match="it is a link"):
            open_it(link)
    os.link(target, tmp_path / "log.txt")
    with pytest.raises(OSError, match="second name"):
        gates.open_to_append(tmp_path / "log.txt")
    with gates.create_plain(link) as file:
        file.write(b"ours")
    assert target.read_bytes() == b"theirs" and link.read_bytes() == b"ours" and not link.is_symlink()


def test_files_above_the_size_limit_are_not_read(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"12345")
    assert gates.read_plain(path, 5) == b"12345"
    with pytest.raises(OSError, match="larger than"):
        gates.read_plain(path, 4)
    with path.open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(OSError, match="larger than"):
        gates.read_plain(path, 1 << 20)


OUTSIDE = ["../a", "..\\a", "a\\..\\..\\b", "/a", "\\\\host\\share", "c:\\a", "c:a", "//h/s/a", "", "a\0"]


@pytest.mark.parametrize("text", OUTSIDE)
def test_paths_that_leave_their_folder_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match="leaves the folder"):
        gates.inner_path(text)


def test_paths_inside_the_folder_are_accepted() -> None:
    assert str(gates.inner_path("passes/12:30 ü.exr")) == "passes/12:30 ü.exr"


def test_passwords_in_addresses_are_hidden_in_messages() -> None:
    told = gates.without_credentials("at https://me:secret@host/simple, http://host")
    assert told == "at https://****@host/simple, http://host"


MARKS = [*range(0x00, 0x09), *range(0x0B, 0x20), 0x7F, *range(0x80, 0xA0), 0x200E, 0x200F, *range(0x2028, 0x202F),
         *range(0x2066, 0x206A), 0xFEFF]  # fmt: skip


@pytest.mark.parametrize("code", MARKS, ids=hex)
def test_terminal_control_characters_are_removed_from_messages(code: int) -> None:
    assert gates.printable(f"a{chr(code)}b") == gates.one_line(f"a{chr(code)}b") == "a?b"


@pytest.mark.parametrize(
    ("fit", "text", "fitted"),
    [
        (gates.one_line, "Stuhl, 椅子, כיסא, كرسي, 🪑", "Stuhl, 椅子, כיסא, كرسي, 🪑"),
        *(
            (fit, "a\u202eb\nc", "a?b c")
            for fit in (gates.one_line, gates.table_cell, gates.markdown_cell, gates.plot_label)
        ),
        *((gates.table_cell, text, f"'{text}") for text in ("=1+1", "+1", "-1", "@SUM(A1)")),
        (gates.table_cell, "chair", "chair"),
        (gates.table_cell, -1.5, -1.5),
        (gates.markdown_cell, "a|b\\|<img src=x>", "a\\|b\\\\\\|&lt;img src=x>"),
    ],
)
def test_texts_are_cleaned_for_terminals_files_and_panels(
    fit: Callable[[object], object], text: object, fitted: object
) -> None:
    assert fit(text) == fitted


def test_dollar_signs_in_plot_labels_are_not_read_as_formulas(tmp_path: Path) -> None:
    pyplot = pytest.importorskip("matplotlib.pyplot", reason="matplotlib is not installed: requirements/test.txt")
    figure, axes = pyplot.subplots()
    axes.set_title(gates.plot_label(r"a $\nothing{$ b"))
    figure.savefig(tmp_path / "plot.svg")
    pyplot.close(figure)


def test_an_error_message_of_many_lines_is_shortened() -> None:
    said = "Error(s) in loading:\n\t" + "\n\t".join(f"size mismatch for layer.{i}" for i in range(100))
    error = PlgsError("made-up", f"the model cannot be read ({said})", "model", "Lift again.")
    assert error.what.isprintable() and len(error.what) == 600 and "Error(s) in loading: size mismatch" in error.what
    assert str(error) == f"{error.what}: model. Lift again."
