"""The AVL index against a naive twin: a sorted list searched with bisect."""

import doctest
from bisect import bisect_left, insort
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import sync.tree
from sync.tree import TIME_LIMIT_NS, FrameTree, in_order, merge_nearest, write_whole

TIMES = st.integers(-TIME_LIMIT_NS + 1, TIME_LIMIT_NS - 1) | st.integers(-50, 50)


class Twin:
    """Sorted list of (time, frame); every answer by the definition."""

    def __init__(self) -> None:
        self.pairs: list[tuple[int, int]] = []

    def add(self, time: int, frame: int) -> bool:
        known = any(key == time for key, _ in self.pairs)
        if not known:
            insort(self.pairs, (time, frame))
        return known

    def nearest(self, time: int, tolerance: int) -> tuple[int, int]:
        at = bisect_left(self.pairs, (time, -1))
        around = self.pairs[max(at - 1, 0) : at + 1]  # the earlier one first, and min keeps the first of equals
        best = min(around, key=lambda pair: abs(pair[0] - time), default=None)
        if best is None or abs(best[0] - time) > tolerance:
            return -1, 0
        return best[1], best[0] - time

    def range(self, start: int, stop: int) -> list[tuple[int, int]]:
        return [pair for pair in self.pairs if start <= pair[0] < stop]


def pairs_of(items: tuple[np.ndarray, np.ndarray]) -> list[tuple[int, int]]:
    return list(zip(items[0].tolist(), items[1].tolist(), strict=True))


def tree_of(times: list[int]) -> FrameTree:
    return FrameTree(times, range(len(times)))


@pytest.mark.parametrize("seed", range(4))
def test_random_operations_equal_the_twin(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    tree, twin, frame = FrameTree(), Twin(), 0
    for _ in range(300):
        match rng.integers(5):
            case 0 | 1:  # runs that go up, down or anywhere, with times that are there already
                count = int(rng.integers(1, 12))
                times = rng.integers(-400, 400, count)
                times = [times, np.sort(times), np.sort(times)[::-1]][rng.integers(3)]
                frames = np.arange(frame, frame + count)
                known = sum(twin.add(int(time), int(number)) for time, number in zip(times, frames, strict=True))
                assert tree.add(times, frames) == known
                frame += count
            case 2:
                asked, tolerance = rng.integers(-450, 450, 20), int(rng.integers(0, 60))
                expected = [twin.nearest(int(time), tolerance) for time in asked]
                assert pairs_of(tree.nearest(asked, tolerance)) == expected
            case 3:
                start, stop = (int(time) for time in rng.integers(-450, 450, 2))
                assert pairs_of(tree.range(start, stop)) == twin.range(start, stop)
            case 4:
                tree.save(tmp_path / "index.avl")
                tree = FrameTree.load(tmp_path / "index.avl")
        tree._check()
        assert len(tree) == len(twin.pairs)
    assert pairs_of(tree.items()) == twin.pairs


@given(st.lists(TIMES, max_size=60), st.lists(TIMES, min_size=1, max_size=20), st.integers(0, 2 * TIME_LIMIT_NS))
def test_any_times_equal_the_twin(times: list[int], asked: list[int], tolerance: int) -> None:
    tree, twin = tree_of(times), Twin()
    for frame, time in enumerate(times):
        twin.add(time, frame)
    tree._check()
    assert pairs_of(tree.items()) == twin.pairs
    assert pairs_of(tree.nearest(asked, tolerance)) == [twin.nearest(time, tolerance) for time in asked]
    start, stop = min(asked), max(asked)
    assert pairs_of(tree.range(start, stop)) == twin.range(start, stop)


@given(st.lists(TIMES, max_size=60), st.lists(TIMES, max_size=60), st.integers(0, 2 * TIME_LIMIT_NS))
def test_merge_equals_search(times: list[int], asked: list[int], tolerance: int) -> None:
    tree, queries = tree_of(times), np.array(sorted(asked), np.int64)
    keys, frames = tree.items()
    positions, residuals = merge_nearest(keys, queries, tolerance)
    found, away = tree.nearest(queries, tolerance)
    assert np.array_equal(np.where(positions >= 0, np.append(frames, -1)[positions], -1), found)
    assert np.array_equal(residuals, away)


@given(st.lists(TIMES, max_size=60), st.lists(TIMES, max_size=60), st.integers(0, 2 * TIME_LIMIT_NS))
def test_merge_with_later_ties_is_the_merge_read_backwards(times: list[int], asked: list[int], tolerance: int) -> None:
    keys, queries = tree_of(times).items()[0], np.array(sorted(asked), np.int64)
    positions, residuals = merge_nearest(keys, queries, tolerance, tie_later=True)
    mirrored, away = merge_nearest(-keys[::-1], -queries[::-1], tolerance)
    assert np.array_equal(positions, np.where(mirrored >= 0, len(keys) - 1 - mirrored, -1)[::-1])
    assert np.array_equal(residuals, -away[::-1])


def test_the_order_of_insertion_changes_no_answer() -> None:
    keys = np.arange(0, 4000, 20)
    between = keys[:-1] + 10
    for seed in range(20):
        order = np.random.default_rng(seed).permutation(len(keys))
        tree = FrameTree(keys[order], order)
        tree._check()
        frames, residuals = tree.nearest(between, 10)
        assert np.array_equal(frames, np.arange(len(between)))  # a tie goes to the earlier frame
        assert (residuals == -10).all()


@pytest.mark.parametrize("order", ["up", "down", "zigzag"])
def test_one_by_one_stays_balanced(order: str) -> None:
    keys = np.arange(2000)
    zigzag = np.ravel(np.column_stack([keys[:1000], keys[:999:-1]]))
    tree = FrameTree()
    for number, key in enumerate({"up": keys, "down": keys[::-1], "zigzag": zigzag}[order]):
        tree.add([key], [number])
    tree._check()
    assert tree._height.max() <= 1.4405 * np.log2(2002)  # the AVL bound


def test_sorted_input_with_duplicates_keeps_the_first() -> None:
    tree = FrameTree([3, 3, 5, 5, 5, 9], [0, 1, 2, 3, 4, 5])
    tree._check()
    assert pairs_of(tree.items()) == [(3, 0), (5, 2), (9, 5)]


def test_tolerance_is_inclusive_and_zero_asks_for_equality() -> None:
    tree = FrameTree([100], [7])
    assert tree.nearest([90, 89], 10)[0].tolist() == [7, -1]
    assert tree.nearest([100, 101], 0)[0].tolist() == [7, -1]


def test_an_empty_tree_answers(tmp_path: Path) -> None:
    tree = FrameTree()
    tree.save(tmp_path / "empty.avl")
    for each in (tree, FrameTree.load(tmp_path / "empty.avl")):
        each._check()
        assert len(each) == 0
        assert each.nearest([1, 2], 10)[0].tolist() == [-1, -1]
        assert len(each.range(-10, 10)[0]) == 0
        assert repr(each) == "FrameTree()"


def test_saving_keeps_the_tree_and_adding_to_a_loaded_one_leaves_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.avl"
    rng = np.random.default_rng(5)
    tree = FrameTree(rng.permutation(1000) * 7, range(1000))
    tree.save(path)
    before = path.read_bytes()
    assert len(before) == 64 + 21 * 1000
    loaded = FrameTree.load(path)
    assert pairs_of(loaded.items()) == pairs_of(tree.items())
    loaded.add([-1, 3, 7000], [1000, 1001, 1002])
    loaded._check()
    assert len(loaded) == 1003
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]  # no scratch files left


@pytest.mark.parametrize("place", [0, 9, 12, 17, 40, 64, 200, 500, 800, 1000, -1])
def test_one_damaged_byte_is_noticed(tmp_path: Path, place: int) -> None:
    path = tmp_path / "a.avl"
    FrameTree(range(50), range(50)).save(path)
    data = bytearray(path.read_bytes())
    data[place] ^= 0x10
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"a\.avl is (damaged|no frame index)"):
        FrameTree.load(path)


@pytest.mark.parametrize("size", [0, 10, 63, 64, 1000])
def test_a_file_cut_short_is_noticed(tmp_path: Path, size: int) -> None:
    path = tmp_path / "a.avl"
    FrameTree(range(50), range(50)).save(path)
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(ValueError, match=r"a\.avl is (damaged|no frame index)"):
        FrameTree.load(path)


def test_a_missing_file_is_missing(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        FrameTree.load(tmp_path / "none.avl")


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "file"
    write_whole(path, b"old")
    with pytest.raises(TypeError):
        write_whole(path, "text is no bytes")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("times", "frames", "message"),
    [
        ([1, 2], [0], "2 times and 1 frames"),
        ([1 << 62], [0], "within 2 \\*\\* 62"),
        ([1], [-1], "frame numbers must be 0"),
        ([1], [1 << 31], "frame numbers must be 0"),
        ([1.5], [0], "times must be integers"),
        ([[1]], [0], "times must be integers"),
    ],
)
def test_bad_input_says_what_must_hold(times: list, frames: list, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FrameTree(times, frames)


def test_a_negative_tolerance_is_refused() -> None:
    with pytest.raises(ValueError, match="0 ns or more"):
        FrameTree([1], [0]).nearest([1], -1)


def test_check_notices_each_kind_of_damage(capsys: pytest.CaptureFixture[str]) -> None:
    def damaged(name: str, node: int, value: int) -> FrameTree:
        tree = FrameTree(range(20), range(20))
        getattr(tree, name)[node] = value
        return tree

    for tree in (
        damaged("_keys", 3, 100),
        damaged("_height", 10, 1),
        damaged("_left", 10, -1),
        damaged("_right", 5, 10),
        damaged("_values", 5, -3),
    ):
        with pytest.raises(AssertionError):
            tree._check()
    assert "keys" in capsys.readouterr().out


def test_docstring_examples_hold() -> None:
    assert doctest.testmod(sync.tree).failed == 0
    assert doctest.testmod(sync.tree).attempted > 5


@given(st.lists(st.tuples(st.integers(-50, 50), st.integers(0, 9)), max_size=40))
def test_frames_in_order_are_those_of_the_index(lines):
    times, frames = [time for time, _ in lines], [frame for _, frame in lines]
    expected = FrameTree(times, frames).items()
    for found, right in zip(in_order(times, frames), expected, strict=True):
        assert np.array_equal(found, right)
        assert found.dtype == right.dtype


def test_frames_that_are_in_order_are_not_copied():
    times = np.arange(5, dtype=np.int64)
    assert np.shares_memory(in_order(times, np.arange(5))[0], times)
    tree = FrameTree(times, np.arange(5))
    tree.add([2, 9], [7, 7])
    tree._check()
    assert times.tolist() == [0, 1, 2, 3, 4]
