"""Every package that a set-up installs has a wheel for Windows and macOS, and its hash is listed."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from engine.job.environment import Version, needed_packages, pinned_versions, requirement_file
from engine.job.handshake import ADDED

SYSTEMS = {"win_amd64": "win32", "macosx_14_0_arm64": "darwin"}
"""The names of the systems in wheels, and what Python calls them. torch has no wheel for an older macOS."""
_PIN = re.compile(r"^([\w.-]+)==(\S+)(?: ; (.*?))? \\$", re.MULTILINE)
_HASH = re.compile(r"sha256:([0-9a-f]{64})")


def pinned(path: Path, platform: str) -> list[str]:
    """The packages of a file of hashes that are installed on a system."""
    found = []
    for name, version, marker in _PIN.findall(path.read_text()):
        condition = re.match(r"sys_platform (==|!=) '(\w+)'", marker)
        if condition is None or (condition[2] == platform) is (condition[1] == "=="):
            found.append(f"{name}=={version}")
    return found


@pytest.mark.slow
@pytest.mark.parametrize("version", [(3, 11), (3, 13)])
@pytest.mark.parametrize("system", SYSTEMS)
def test_packages_have_wheels_for_windows_and_macos(root: Path, tmp_path: Path, system: str, version: Version) -> None:
    """pip chooses as it would there, from the package index; it downloads what describes the packages only."""
    assert version in pinned_versions(root)
    files = [requirement_file(root, "hashes", version), *(requirement_file(root, f"hashes-{name}") for name in ADDED)]
    wanted = {pin for path in files for pin in pinned(path, SYSTEMS[system])}
    torch = f"torch=={needed_packages(root, version, SYSTEMS[system])['torch']}"
    report = tmp_path / "report.json"
    command = [
        sys.executable, "-m", "pip", "install", "--dry-run", "--quiet", "--no-deps", "--ignore-installed",
        "--ignore-requires-python", "--only-binary", ":all:", "--platform", system,
        "--python-version", f"{version[0]}.{version[1]}", "--target", tmp_path / "none", "--report", report,
        torch, *wanted,
    ]  # fmt: skip
    said = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert said.returncode == 0, said.stderr[-2000:]
    chosen = json.loads(report.read_text())["install"]
    assert len(chosen) == len(wanted) + 1
    listed = {digest for path in files for digest in _HASH.findall(path.read_text())}
    hashes = {each["metadata"]["name"]: each["download_info"]["archive_info"]["hashes"]["sha256"] for each in chosen}
    assert {name for name, digest in hashes.items() if digest not in listed} == {"torch"}, "torch alone has no hashes"
