"""A folder of results belongs to one capture."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from pipelines.folder import IDENTITY, claim
from pipelines.server import own_home, serving
from sync.capture import find_capture


def _capture(folder: Path, size: int = 10) -> Path:
    (folder / "videos").mkdir(parents=True)
    for name in ("cam1", "cam2"):
        (folder / "videos" / f"{name}.mp4").write_bytes(b"x" * size)
    return folder


def test_another_capture_of_the_same_name_is_refused_though_it_holds_the_same(tmp_path):
    one, two = (_capture(tmp_path / day / "dance") for day in ("day1", "day2"))
    results = tmp_path / "runs" / "dance"
    claim(results, find_capture(one))
    claim(results, find_capture(one))
    with pytest.raises(ValueError, match=r"holds the results of .*day1/dance, but this .*day2/dance; choose"):
        claim(results, find_capture(two))


def test_a_capture_that_was_moved_keeps_its_results(tmp_path):
    one, results = _capture(tmp_path / "day1" / "dance"), tmp_path / "runs" / "dance"
    claim(results, find_capture(one))
    moved = tmp_path / "archive" / "dance"
    shutil.move(one, moved)
    claim(results, find_capture(moved))
    other = _capture(tmp_path / "elsewhere" / "dance", size=11)
    shutil.rmtree(moved)
    with pytest.raises(ValueError, match=r"holds the results of .*archive/dance"):
        claim(results, find_capture(other))


@pytest.mark.parametrize("damage", [b"", b'{"capture": "/sh', b"[]", b"{}", b"\xff"])
def test_a_folder_that_does_not_tell_whose_it_is_is_named(tmp_path, damage):
    capture, results = find_capture(_capture(tmp_path / "dance")), tmp_path / "runs" / "dance"
    claim(results, capture)
    (results / IDENTITY).write_bytes(damage)
    with pytest.raises(ValueError, match=rf"runs/dance/{IDENTITY} must tell whose results lie beside it"):
        claim(results, capture)
    (results / IDENTITY).unlink()
    claim(results, capture)


def test_who_serves_a_folder_that_is_served_is_told_so(tmp_path):
    told = pytest.raises(ValueError, match="is running already; end that one first")
    with own_home(tmp_path, "serve"), told, own_home(tmp_path, "serve"):
        pass
    told = pytest.raises(ValueError, match="is running already: http://a/api; end that one first")
    with serving(tmp_path, "http://a/api"), told, serving(tmp_path, "http://b/api"):
        pass
