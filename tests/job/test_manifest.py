"""manifest.json: no manifest, no result; and nothing in the result can change unseen."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from engine.errors import PlgsError
from engine.job import check_sizes, read_manifest, verify, write_manifest


@pytest.fixture
def result(tmp_path: Path) -> Path:
    (tmp_path / "passes").mkdir()
    (tmp_path / "passes" / "0001.exr").write_bytes(b"pixels")
    (tmp_path / "anchors.npz").write_bytes(b"anchors")
    (tmp_path / ".part-anchors.npz").write_bytes(b"half")
    write_manifest(tmp_path, versions={"torch": "2"}, seed=7, settings={"steps": 3}, timings={"train": 1.5})
    return tmp_path


def test_it_lists_every_file(result: Path) -> None:
    manifest = verify(result)
    assert [(str(file.path), file.bytes) for file in manifest.files] == [("anchors.npz", 7), ("passes/0001.exr", 6)]
    assert manifest.seed == 7 and manifest.settings == {"steps": 3}
    assert manifest.versions == {"torch": "2"} and manifest.timings == {"train": 1.5}
    assert not (result / ".part-anchors.npz").exists()


def test_writing_it_again_changes_nothing(result: Path) -> None:
    before = (result / "manifest.json").read_bytes()
    write_manifest(result, versions={"torch": "2"}, seed=7, settings={"steps": 3}, timings={"train": 1.5})
    assert (result / "manifest.json").read_bytes() == before


def test_it_sees_what_changed(result: Path) -> None:
    (result / "anchors.npz").write_bytes(b"ANCHORS")
    check_sizes(result)
    with pytest.raises(PlgsError, match=r"was changed.*anchors\.npz"):
        verify(result)
    (result / "anchors.npz").write_bytes(b"anch")
    with pytest.raises(PlgsError, match="has 4 bytes, but 7 were written"):
        check_sizes(result)
    (result / "anchors.npz").unlink()
    with pytest.raises(PlgsError, match="is missing"):
        check_sizes(result)


def test_it_refuses_a_damaged_manifest(result: Path) -> None:
    path = result / "manifest.json"
    whole = json.loads(path.read_text())
    for change in (
        {"format": 9},
        {"files": None},
        {"files": [{"path": "../secret", "bytes": 1, "sha256": ""}]},
        {"files": [{"path": "/secret", "bytes": 1, "sha256": ""}]},
        {"files": [{"path": "a"}]},
        {"seed": "seven"},
        {"timings": []},
    ):
        path.write_text(json.dumps(whole | change))
        with pytest.raises(PlgsError, match=r"manifest\.json"):
            read_manifest(result)
    for name in ("a\0b", "a\ud800b"):
        path.write_text(json.dumps(whole | {"files": [{"path": name, "bytes": 1, "sha256": ""}]}))
        with pytest.raises(PlgsError, match=r"manifest\.json"):
            check_sizes(result)
    path.write_text('{"format": ' + "[" * 100_000)
    with pytest.raises(PlgsError, match=r"nested too deeply.*manifest\.json"):
        read_manifest(result)
    path.write_text("{")
    with pytest.raises(PlgsError, match=r"manifest\.json"):
        read_manifest(result)
    path.unlink()
    with pytest.raises(PlgsError, match="not finished"):
        read_manifest(result)
