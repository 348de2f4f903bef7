"""The second process that compiles: whatever becomes of it, the first one goes on."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from engine.machine import companion


@pytest.fixture
def modules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder whose modules a companion can run."""
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path


def test_runs_a_module_and_waits_for_it(modules: Path) -> None:
    (modules / "leaves_a_mark.py").write_text(f"open({str(modules / 'mark')!r}, 'w').close()")
    companion.Companion("leaves_a_mark").wait()
    assert (modules / "mark").exists()


def test_finds_the_engine_wherever_it_is_called_from(
    modules: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (modules / "imports_the_engine.py").write_text("import engine.machine.compiled")
    monkeypatch.chdir(modules)
    companion.Companion("imports_the_engine").wait()
    assert not caplog.records


def test_says_what_went_wrong(modules: Path, caplog: pytest.LogCaptureFixture) -> None:
    (modules / "breaks.py").write_text("raise RuntimeError('no more memory')")
    companion.Companion("breaks").wait()
    assert "RuntimeError: no more memory" in caplog.text


def test_does_not_wait_for_one_that_hangs(
    modules: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(companion, "LEAST_PATIENCE", 0.2)
    (modules / "hangs.py").write_text("import time; time.sleep(60)")
    start = time.monotonic()
    companion.Companion("hangs").wait()
    assert time.monotonic() - start < 20
    assert "took too long" in caplog.text


def test_one_that_cannot_be_started_is_done_without(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(companion.sys, "executable", "/nowhere/python")
    companion.Companion("engine").wait()
    assert "compiling alone" in caplog.text
