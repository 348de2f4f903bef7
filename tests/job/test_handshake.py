"""``python -m engine handshake``: at once, whatever is missing."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from engine import __version__
from engine.job.handshake import TOO_OLD, EngineAnswer, answer
from engine.json_file import to_line

NO_SITE = [sys.executable, "-S", "-m", "engine", "handshake"]
"""The same Python without its packages."""


def test_the_handshake_prints_one_line_about_the_engine(root: Path) -> None:
    said = subprocess.run(
        [sys.executable, "-m", "engine", "handshake"], cwd=root, capture_output=True, text=True, timeout=120
    )
    found = EngineAnswer.from_line(said.stdout)
    assert found is not None and said.stdout.count("\n") == 1 and said.stderr == ""
    assert found.engine == __version__ and found.python == sys.version.split()[0] and found.cpus >= 1
    assert found.packages["numpy"] and found.wanted["torch"]
    assert bool(found.fix) is bool(found.missing)


def test_the_handshake_reports_missing_packages_with_a_fix(root: Path) -> None:
    said = subprocess.run(NO_SITE, cwd=root, capture_output=True, text=True, timeout=120)
    assert said.returncode == 0
    facts = json.loads(said.stdout)
    assert {"torch", "numpy", "opencv-contrib-python-headless"} <= set(facts["missing"])
    assert all(version is None for version in facts["packages"].values())
    assert f"uv pip install --python {sys.executable} torch=={facts['wanted']['torch']} " in facts["fix"]


def test_the_handshake_reports_cuda_and_package_versions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, version in (("torch", "9.0+cu130"), ("safetensors", "0.0.1")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").touch()
        info = tmp_path / f"{name}-{version}.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    (tmp_path / "torch" / "version.py").write_text("from typing import Optional\ncuda: Optional[str] = '13.0'\n")
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    monkeypatch.delitem(sys.modules, "torch", raising=False)
    monkeypatch.delitem(sys.modules, "safetensors", raising=False)
    found = answer()
    assert found.cuda == "13.0" and found.packages["torch"] == "9.0+cu130"
    assert any(line.startswith("safetensors 0.0.1 instead of ") for line in found.others)


def test_a_handshake_answer_is_read_back_as_written() -> None:
    sent = answer()
    data = json.loads(to_line(sent.to_json()))
    assert EngineAnswer.from_json(data) == sent
    for other in ({}, {**data, "format": 1}, {**data, "cpus": "many"}):
        assert EngineAnswer.from_json(other) is None


def test_a_python_too_old_for_the_engine_is_reported(root: Path) -> None:
    code = "import runpy, sys; sys.version_info = (3, 9, 1); runpy.run_module('engine', run_name='__main__')"
    said = subprocess.run(
        [sys.executable, "-c", code, "handshake"], cwd=root, capture_output=True, text=True, timeout=120
    )
    assert said.returncode != 0 and TOO_OLD in said.stderr and "Traceback" not in said.stderr
