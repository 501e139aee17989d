"""Room on a disk."""

from __future__ import annotations

import os

import pytest

from pipelines.disk import free_bytes, size_text, used_bytes


def test_room_is_that_of_the_disk_where_a_path_would_be(tmp_path):
    there = os.statvfs(tmp_path)
    # Others write meanwhile: within a gigabyte.
    assert free_bytes(tmp_path / "not" / "yet") == pytest.approx(there.f_bavail * there.f_frsize, abs=1e9)


def test_what_is_not_written_takes_nothing(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "written").write_bytes(bytes(range(256)) * 4096)
    with open(tmp_path / "sparse", "wb") as file:
        file.truncate(2**30)
    assert 2**20 <= used_bytes(tmp_path) < 2**21


def test_bytes_in_words():
    assert [size_text(count) for count in (0, 999, 12_300, 4.56e6, 7.89e9)] == [
        "0 B",
        "999 B",
        "12.3 kB",
        "4.56 MB",
        "7.9 GB",
    ]
