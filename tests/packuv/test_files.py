"""What is written is whole or absent."""

from __future__ import annotations

import ast
import time
from concurrent.futures import ThreadPoolExecutor
from threading import Lock

import numpy as np
import pytest

from packuv.files import load_npy, map_npy, open_npz, save_npz, whole_file, whole_folder


def test_threads_that_read_arrays_take_turns_at_their_headers(tmp_path, monkeypatch):
    """Python before 3.11.8 fails where two threads build syntax trees at once, as NumPy does of headers."""
    np.save(tmp_path / "a.npy", np.arange(6))
    save_npz(tmp_path / "a.npz", {"a": np.arange(6)})
    inside, parse = Lock(), ast.literal_eval

    def parsed_alone(text):
        assert inside.acquire(blocking=False)
        time.sleep(1e-3)
        inside.release()
        return parse(text)

    def read(number):
        with open_npz(tmp_path / "a.npz") as arrays:
            return (map_npy if number % 2 else load_npy)(tmp_path / "a.npy").sum() + arrays["a"].sum()

    monkeypatch.setattr(ast, "literal_eval", parsed_alone)
    with ThreadPoolExecutor(8) as pool:
        assert set(pool.map(read, range(40))) == {30}


def test_a_file_appears_when_it_is_whole(tmp_path):
    path = tmp_path / "a.mkv"
    path.write_text("old")
    with whole_file(path) as partial:
        assert partial.suffix == ".mkv"  # encoders choose the container by it
        partial.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_appears_when_it_is_whole(tmp_path):
    for name in ("new", "empty"):
        (tmp_path / "empty").mkdir(exist_ok=True)
        with whole_folder(tmp_path / name) as partial:
            (partial / "a").write_text("a")
            assert not list((tmp_path / name).glob("*"))
        assert [path.name for path in (tmp_path / name).iterdir()] == ["a"]
        with pytest.raises(FileExistsError, match="must be new or an empty folder"), whole_folder(tmp_path / name):
            pass
    (tmp_path / "file").write_text("")
    with pytest.raises(FileExistsError), whole_folder(tmp_path / "file"):
        pass


@pytest.mark.parametrize("whole", [whole_file, whole_folder])
def test_an_error_leaves_nothing_behind(tmp_path, whole):
    def interrupted():
        with whole(tmp_path / "a") as partial:
            (partial / "part" if whole is whole_folder else partial).write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert not list(tmp_path.iterdir())
    with pytest.raises(FileNotFoundError, match=r"no folder .*none to write a in"), whole(tmp_path / "none" / "a"):
        pass


def test_a_file_is_not_written_over_a_folder(tmp_path):
    with pytest.raises(IsADirectoryError, match="is a folder; name a file"), whole_file(tmp_path):
        pass
    with pytest.raises(FileNotFoundError, match="make it first"), whole_file(tmp_path / "none" / "a.npz"):
        pass
