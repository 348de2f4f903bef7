"""The extension as users get it: the zip that Blender's own tool builds, installed in a Blender without settings."""

import hashlib
import json
import os
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

from engine import __version__

INSIDE = """
import sys
import bpy

bpy.ops.extensions.package_install_files(
    filepath=sys.argv[1], repo="user_default", enable_on_install=True, overwrite=True
)
name = "bl_ext.user_default.plgs"
assert name in bpy.context.preferences.addons, "not switched on"
module = sys.modules[name]
assert module.__file__.startswith(bpy.utils.user_resource("EXTENSIONS")), module.__file__
assert hasattr(bpy.types.Scene, "plgs"), "registered nothing"
outside = sorted(each for each in sys.modules if each.split(".")[0] in ("engine", "plgs_blender", "torch", "cv2"))
assert outside == [], outside
bpy.ops.preferences.addon_disable(module=name)
assert not hasattr(bpy.types.Scene, "plgs"), "still registered"
print("all is well")
"""


@pytest.fixture(scope="module")
def package(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The zip, built and judged by Blender's own tool."""
    folder = tmp_path_factory.mktemp("extension")
    # With a blender on PATH that has no tool yet, as Debian 12's, it is that of the bpy module that runs this test.
    old = folder / "blender"
    old.write_text('#!/bin/sh\n[ "$1" = --version ] && echo Blender 3.4.1 && exit 0\nexit 1\n')
    old.chmod(0o755)
    command = [sys.executable, str(root / "set_up" / "extension.py"), str(folder)]
    process = subprocess.run(
        command, env=os.environ | {"PATH": str(folder)}, capture_output=True, text=True, timeout=120
    )
    assert process.returncode == 0, process.stderr
    (path,) = folder.glob("*.zip")
    return path


def test_the_build_folder_is_a_blender_extension_repository(package: Path) -> None:
    index = json.loads((package.parent / "index.json").read_text(encoding="utf-8"))
    (entry,) = index["data"]
    assert entry["id"] == "plgs" and (package.parent / entry["archive_url"]).samefile(package)
    assert entry["archive_size"] == package.stat().st_size
    assert entry["archive_hash"] == f"sha256:{hashlib.sha256(package.read_bytes()).hexdigest()}"
    assert "index.json" in (package.parent / "index.html").read_text(encoding="utf-8")


def test_the_zip_holds_the_code_and_the_engines_requirements(root: Path, package: Path) -> None:
    with zipfile.ZipFile(package) as zipped:
        names = set(zipped.namelist())
    parts = ("engine", "operators", "plgs_blender", "ui")
    assert {path.relative_to(root).as_posix() for part in parts for path in (root / part).rglob("*.py")} <= names
    needed = {"torch.txt", "engine.txt", "constraints-3.11.txt", "constraints-3.13.txt", "hashes-3.11.txt"}
    assert {f"requirements/{name}" for name in needed} <= names
    tops = {name.partition("/")[0] for name in names}
    files = {"blender_manifest.toml", "__init__.py", "run_plgs.py", "LICENSE", "README.md", "CHANGELOG.md"}
    files.add("SECURITY.md")
    assert tops == files | {*parts, "docs", "farm", "requirements", "sample"}
    sample = {name for name in names if name.startswith("sample/")}
    assert "sample/room/LICENSE" in sample and not any("/gt/" in name or "_second" in name for name in sample)
    with zipfile.ZipFile(package) as zipped:
        assert sum(zipped.getinfo(name).file_size for name in sample) < 8e6


def test_links_in_the_zip_lead_somewhere(package: Path) -> None:
    with zipfile.ZipFile(package) as zipped:
        names = set(zipped.namelist())
        pages = {name: zipped.read(name).decode() for name in names if name.endswith(".md")}
    for name, text in pages.items():
        targets = re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text)
        lost = [each for each in targets if os.path.normpath(Path(name).parent / each) not in names]
        assert lost == [], name


def test_the_zip_has_no_files_for_one_platform_only(root: Path, package: Path) -> None:
    with zipfile.ZipFile(package) as zipped:
        manifest = tomllib.loads(zipped.read("blender_manifest.toml").decode())
        endings = {Path(name).suffix for name in zipped.namelist()}
    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))
    assert manifest["version"] == project["project"]["version"] == __version__
    assert manifest["id"] == "plgs" and manifest["blender_version_min"] == "4.2.0"
    assert not {"wheels", "platforms", "blender_version_max"} & set(manifest)
    assert endings <= {".py", ".txt", ".toml", ".json", ".md", ".csv", ".js", ".jpg", ".png", ""}


def test_the_zip_can_be_installed_enabled_and_removed(package: Path, tmp_path: Path) -> None:
    environment = os.environ | {"BLENDER_USER_RESOURCES": str(tmp_path / "resources")}
    command = [sys.executable, "-c", INSIDE, str(package)]
    process = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120)
    assert process.returncode == 0 and "all is well" in process.stdout, process.stdout + process.stderr
