"""Asking a Python whether the engine answers in it: whatever it is, the answer comes soon and says what to do."""

from __future__ import annotations

import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import pytest
from plgs.engine.job.handshake import TOO_OLD, EngineAnswer
from plgs.plgs_blender.engine_environment.handshake import Handshake, NoAnswer, Reason

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="shell scripts in the place of Pythons")


def ask(python: Path) -> EngineAnswer | NoAnswer:
    with closing(Handshake(python, patience_s=60.0)) as handshake:
        give_up = time.monotonic() + 30.0
        while (answer := handshake.poll()) is None:
            assert time.monotonic() < give_up
            time.sleep(0.01)
        return answer


def script(path: Path, text: str) -> Path:
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return path


def test_this_python_answers() -> None:
    answer = ask(Path(sys.executable))
    assert isinstance(answer, EngineAnswer) and answer.python == sys.version.split()[0]
    assert answer.packages["numpy"] is not None


def test_a_python_without_torch_tells_what_it_lacks(tmp_path: Path) -> None:
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", tmp_path / "bare"], check=True, timeout=120)
    answer = ask(tmp_path / "bare" / "bin" / "python")
    assert isinstance(answer, EngineAnswer) and "torch" in answer.missing
    assert str(tmp_path / "bare") in answer.fix and "pip install torch==" in answer.fix


def test_what_is_no_engine_is_told_apart(tmp_path: Path) -> None:
    picture = tmp_path / "picture.png"
    picture.write_bytes(b"\x89PNG")
    executable_picture = tmp_path / "run.png"
    executable_picture.write_bytes(b"\x89PNG\r\n\x1a\n\0\0")
    executable_picture.chmod(0o755)
    other = '{"format": 1, "engine": "99.0", "python": "3.11.1", "executable": "/p", "packages": {}, "wanted": {}, '
    other += '"cpus": 1, "cuda": null}'
    for python, reason, told in (
        (tmp_path / "none", Reason.DOES_NOT_RUN, "none"),
        (picture, Reason.DOES_NOT_RUN, "picture.png"),
        (executable_picture, Reason.DOES_NOT_RUN, "run.png"),
        (tmp_path, Reason.DOES_NOT_RUN, str(tmp_path)),
        (script(tmp_path / "a", "echo hello"), Reason.GARBAGE, "not as a Python"),
        (script(tmp_path / "b", "true"), Reason.GARBAGE, "not as a Python"),
        (script(tmp_path / "c", "echo '[1]'"), Reason.GARBAGE, "not as a Python"),
        (script(tmp_path / "d", f"echo '{other}'"), Reason.OTHER_VERSION, "99.0"),
        (script(tmp_path / "e", "echo No module named engine >&2; exit 1"), Reason.DOES_NOT_RUN, "No module named"),
        (script(tmp_path / "f", f"echo 'error: {TOO_OLD}, this is 3.9' >&2; exit 1"), Reason.WRONG_PYTHON, "3.9"),
        (script(tmp_path / "g", "kill -SEGV $$"), Reason.DOES_NOT_RUN, "does not run"),
    ):
        answer = ask(python)
        assert isinstance(answer, NoAnswer) and answer.reason is reason, (python, answer)
        assert told in answer.message and answer.fix


def test_a_script_that_hangs_is_given_up_and_ended(tmp_path: Path) -> None:
    written = tmp_path / "pid"
    hanging = script(tmp_path / "hanging", f"echo $$ > {written}.part; mv {written}.part {written}; sleep 60")
    now = [100.0]
    with closing(Handshake(hanging, patience_s=0.5, clock=lambda: now[0])) as handshake:
        give_up = time.monotonic() + 30.0
        while not written.exists():
            assert time.monotonic() < give_up
            time.sleep(0.01)
        now[0] = 100.5
        assert handshake.poll() is None
        now[0] = 100.6
        answer = handshake.poll()
    assert isinstance(answer, NoAnswer) and answer.reason is Reason.HUNG
    pid = int(written.read_text())
    assert not Path(f"/proc/{pid}").exists()


def test_endless_output_is_no_burden(tmp_path: Path) -> None:
    answer = ask(script(tmp_path / "talkative", "head -c 50000000 /dev/zero; exit 1"))
    assert isinstance(answer, NoAnswer) and len(answer.message) < 1000
