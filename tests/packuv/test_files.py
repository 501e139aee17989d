"""What is written is whole or absent."""

from __future__ import annotations

import pytest

from packuv.files import whole_file, whole_folder


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
