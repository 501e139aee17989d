"""The index of a camera: an AVL tree from timecode to frame, held in arrays (paper, algorithms 1 and 2).

A node is a position in five arrays: key, value, left and right child, height. So a tree is built, searched, saved and
memory-mapped without one Python object per node. Times are int64 nanoseconds, frames int32 frame numbers.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numba import njit

TIME_LIMIT_NS = 1 << 62
"""Times lie strictly within this, so that the difference of any two fits in int64."""

MAGIC = b"PUV-AVL\n"
FORMAT = 1
_HEADER = struct.Struct("<8sIIqq32x")  # magic, format, CRC-32 of all that follows the CRC, nodes, root
_COLUMNS = (("<i8", 8), ("<i4", 4), ("<i4", 4), ("<i4", 4), ("|i1", 1))
_MOST_LEVELS = 64  # an AVL tree of 2 ** 31 nodes has at most 45


class FrameTree:
    """Sorted map from timecode to frame number, with search for the nearest.

    Of lines with the same timecode the first is kept.

    >>> tree = FrameTree([0, 40, 20], [7, 9, 8])
    >>> len(tree)
    3
    >>> tree.nearest([18, 30, 70], tolerance_ns=10)
    (array([ 8,  8, -1], dtype=int32), array([  2, -10,   0]))
    """

    def __init__(
        self, times: Iterable[int] | np.ndarray | None = None, frames: Iterable[int] | np.ndarray | None = None
    ) -> None:
        self._keys = np.empty(0, np.int64)
        self._values, self._left, self._right = (np.empty(0, np.int32) for _ in range(3))
        self._height = np.empty(0, np.int8)
        self._root, self._count = -1, 0
        if times is not None:
            self.add(times, [] if frames is None else frames)

    def __len__(self) -> int:
        """Number of distinct timecodes. `O(1)`."""
        return self._count

    def __repr__(self) -> str:
        if not len(self):
            return "FrameTree()"
        times, _ = self.items()
        return f"<FrameTree of {len(self)} frames, {times[0]} to {times[-1]} ns>"

    def add(self, times: Iterable[int] | np.ndarray, frames: Iterable[int] | np.ndarray) -> int:
        """Add frames by their times, int64 [n] and int32 [n]; return how many were there already and left out.

        `O(n)` into an empty tree if the times are in order, `O(n log(n))` otherwise.

        >>> tree = FrameTree([0, 40], [0, 2])
        >>> tree.add([20, 40], [1, 99])
        1
        >>> tree.items()
        (array([ 0, 20, 40]), array([0, 1, 2], dtype=int32))

        Raises:
            ValueError: lengths differ, a time is beyond 2 ** 62 ns or a frame is no int32 >= 0.
        """
        keys, values = _checked_times(times), _checked_frames(frames)
        if len(keys) != len(values):
            raise ValueError(f"every time needs a frame, but there are {len(keys)} times and {len(values)} frames")
        before = self._count
        if before == 0 and (np.diff(keys) >= 0).all():
            first = np.diff(keys, prepend=-TIME_LIMIT_NS) > 0
            self._build(keys[first], values[first])
        else:
            self._reserve(before + len(keys))
            self._root, self._count = _insert(*self._arrays(), self._root, before, keys, values)
        return len(keys) - (self._count - before)

    def nearest(self, times: Iterable[int] | np.ndarray, tolerance_ns: int) -> tuple[np.ndarray, np.ndarray]:
        """Frame nearest to each time, and its time minus the asked one.

        Of two frames equally near the earlier is taken, whatever the order in which they were added. (The paper's
        search takes whichever it meets first, so its answer depends on that order.) `O(log(n))` per time.

        Returns:
            frames: int32 [n], -1 where none is within the tolerance (which is inclusive).
            residuals: int64 [n], ns; 0 where there is none.

        >>> FrameTree([0, 20], [5, 6]).nearest([10, 21], tolerance_ns=15)
        (array([5, 6], dtype=int32), array([-10,  -1]))
        """
        wanted = _checked_times(times)
        nodes = _find(self._keys, self._left, self._right, self._root, wanted, _checked_tolerance(tolerance_ns))
        found = nodes >= 0
        frames = np.full(len(wanted), -1, np.int32)
        residuals = np.zeros(len(wanted), np.int64)
        frames[found] = self._values[nodes[found]]
        residuals[found] = self._keys[nodes[found]] - wanted[found]
        return frames, residuals

    def range(self, start_ns: int, stop_ns: int) -> tuple[np.ndarray, np.ndarray]:
        """Times and frames with start <= time < stop, in order of time. `O(log(n) + found)`.

        >>> FrameTree([0, 20, 40], [5, 6, 7]).range(20, 40)
        (array([20]), array([6], dtype=int32))
        """
        start, stop = (min(max(time, -TIME_LIMIT_NS), TIME_LIMIT_NS) for time in (int(start_ns), int(stop_ns)))
        nodes = _walk(self._keys, self._left, self._right, self._root, self._count, start, stop)
        return self._keys[nodes], self._values[nodes]

    def items(self) -> tuple[np.ndarray, np.ndarray]:
        """All times, int64 [n], strictly increasing, and their frames, int32 [n]. `O(n)`."""
        return self.range(-TIME_LIMIT_NS, TIME_LIMIT_NS)

    def save(self, path: Path) -> None:
        """Write one file of 64 + 21 bytes per frame, complete or not at all (docs/sync.md has its layout)."""
        n = self._count
        columns = zip(self._arrays(), _COLUMNS, strict=True)
        payload = b"".join(array[:n].astype(kind).tobytes() for array, (kind, _) in columns)
        head = _HEADER.pack(MAGIC, FORMAT, 0, n, self._root)
        checksum = zlib.crc32(payload, zlib.crc32(head[16:]))
        write_whole(path, _HEADER.pack(MAGIC, FORMAT, checksum, n, self._root) + payload)

    @classmethod
    def load(cls, path: Path) -> FrameTree:
        """Map a saved tree into memory; adding to it later leaves the file alone.

        Raises:
            FileNotFoundError: no such file.
            ValueError: not an index, of another format, cut short or damaged.
        """
        if path.stat().st_size < _HEADER.size:
            raise ValueError(f"{path} is no frame index: {path.stat().st_size} bytes are less than its header")
        data = np.memmap(path, np.uint8, "c")
        magic, form, checksum, count, root = _HEADER.unpack(data[: _HEADER.size].tobytes())
        if magic != MAGIC or form != FORMAT:
            raise ValueError(f"{path} is no frame index of format {FORMAT}; delete it and run sync again")
        size = _HEADER.size + count * sum(width for _, width in _COLUMNS)
        if len(data) != size or zlib.crc32(data[16:].data) != checksum:
            raise ValueError(f"{path} is damaged ({len(data)} bytes, {size} expected); delete it and run sync again")
        tree, at, arrays = cls(), _HEADER.size, []
        for kind, width in _COLUMNS:
            arrays.append(np.asarray(data[at : at + count * width]).view(kind))
            at += count * width
        tree._keys, tree._values, tree._left, tree._right, tree._height = arrays
        tree._root, tree._count = root, count
        return tree

    def _arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        return self._keys, self._values, self._left, self._right, self._height

    def _build(self, keys: np.ndarray, values: np.ndarray) -> None:
        """Balanced tree of strictly increasing keys; node i is the i-th key."""
        n = len(keys)
        self._keys, self._values = keys.copy(), values.copy()
        self._left, self._right = np.empty(n, np.int32), np.empty(n, np.int32)
        self._height = np.empty(n, np.int8)
        self._root, self._count = _balanced(self._left, self._right, self._height), n

    def _reserve(self, nodes: int) -> None:
        """Room for `nodes` nodes; grows by doubling, so that adding one by one costs `O(1)` copies each."""
        if nodes <= len(self._keys):
            return
        room = max(nodes, 2 * len(self._keys))
        self._keys, self._values, self._left, self._right, self._height = (
            np.concatenate([array[: self._count], np.empty(room - self._count, array.dtype)])
            for array in self._arrays()
        )

    def _check(self) -> None:
        """Assert every invariant; print the tree where one fails."""
        try:
            n = self._count
            keys, values, left, right, height = (array[:n] for array in self._arrays())
            children = np.concatenate([left[left >= 0], right[right >= 0]])
            assert (self._root == -1) == (n == 0)
            assert ((left >= -1) & (left < n) & (right >= -1) & (right < n)).all(), "a child is no node"
            expected = np.delete(np.arange(n), self._root) if n else np.arange(0)
            assert np.array_equal(np.sort(children), expected), "a node must hang from exactly one parent"
            padded = np.append(height, 0).astype(np.int64)  # child -1 reads the 0 at the end
            tall, low = np.maximum(padded[left], padded[right]), np.minimum(padded[left], padded[right])
            assert (height == tall + 1).all(), "a height is wrong"
            assert (tall - low <= 1).all(), "a node is out of balance"
            times, frames = self.items()
            assert len(times) == n, "some times cannot be reached"
            assert (np.diff(times) > 0).all(), "times are out of order"
            assert (values >= 0).all(), "a frame number is negative"
            assert np.array_equal(np.sort(frames), np.sort(values))
            assert np.array_equal(np.sort(keys), times)
        except AssertionError:
            print("count", self._count, "root", self._root)
            for name, array in zip(("keys", "values", "left", "right", "height"), self._arrays(), strict=True):
                print(name, array)
            raise


def in_order(times: Iterable[int] | np.ndarray, frames: Iterable[int] | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`FrameTree(times, frames).items()`, without a tree, and without a copy, where the times increase strictly.

    >>> in_order([0, 40, 20, 40], [0, 2, 1, 9])
    (array([ 0, 20, 40]), array([0, 1, 2], dtype=int32))
    """
    keys, values = _checked_times(times), _checked_frames(frames)
    if len(keys) == len(values) and (keys[1:] > keys[:-1]).all():
        return keys, values
    return FrameTree(keys, values).items()


def merge_nearest(
    keys: np.ndarray, times: np.ndarray, tolerance_ns: int, *, tie_later: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """`FrameTree.nearest` for a whole sorted sequence at once: one walk along both arrays. `O(n + m)`.

    Args:
        keys: int64 [n], strictly increasing, as `FrameTree.items` returns them.
        times: int64 [m], in order.
        tie_later: of two keys equally near take the later one, not the earlier.

    Returns:
        positions: int64 [m] into `keys`, -1 where none is within the tolerance.
        residuals: int64 [m], key minus time, ns; 0 where there is none.
    """
    positions, residuals = np.empty(len(times), np.int64), np.empty(len(times), np.int64)
    _merge(keys, times, _checked_tolerance(tolerance_ns), tie_later, positions, residuals)
    return positions, residuals


def merge_mutual(keys: np.ndarray, times: np.ndarray, tolerance_ns: int) -> tuple[np.ndarray, np.ndarray]:
    """`merge_nearest`, but only where each is the other's nearest; `times` must increase strictly, too."""
    positions, residuals = merge_nearest(keys, times, tolerance_ns)
    # ties the other way round, or two that are exactly half a period apart would never find each other
    back, _ = merge_nearest(times, keys, tolerance_ns, tie_later=True)
    _keep_mutual(positions, residuals, back)
    return positions, residuals


@contextmanager
def whole_file(path: Path) -> Iterator[BinaryIO]:
    """A file to write that is there with all its bytes, or not at all, even after a power cut."""
    scratch = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with open(scratch, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(scratch, path)
    finally:
        scratch.unlink(missing_ok=True)


def write_whole(path: Path, data: bytes) -> None:
    """Write all of a file, or nothing, see `whole_file`."""
    with whole_file(path) as file:
        file.write(data)


def _checked_times(times: Iterable[int] | np.ndarray) -> np.ndarray:
    array = _integers(times, "times")
    if len(array) and not (array.min() > -TIME_LIMIT_NS and array.max() < TIME_LIMIT_NS):
        raise ValueError(f"times must lie within 2 ** 62 ns of 0, but reach from {array.min()} to {array.max()}")
    return array.astype(np.int64, copy=False)


def _checked_frames(frames: Iterable[int] | np.ndarray) -> np.ndarray:
    array = _integers(frames, "frames")
    if len(array) and not (array.min() >= 0 and array.max() < 1 << 31):
        raise ValueError(f"frame numbers must be 0 to 2 ** 31 - 1, but reach from {array.min()} to {array.max()}")
    return array.astype(np.int32, copy=False)


def _integers(values: Iterable[int] | np.ndarray, name: str) -> np.ndarray:
    array = np.asarray(values if isinstance(values, np.ndarray) else list(values))
    if array.ndim != 1 or (array.size and array.dtype.kind not in "iu"):
        raise ValueError(f"{name} must be integers [n], but are {array.dtype} {array.shape}")
    return array


def _checked_tolerance(tolerance_ns: int) -> int:
    if tolerance_ns < 0:
        raise ValueError(f"a tolerance must be 0 ns or more, but is {tolerance_ns}")
    return min(int(tolerance_ns), 2 * TIME_LIMIT_NS - 1)


# Kernels. `left`, `right` and `root` are node numbers, -1 for none.


@njit(cache=True, error_model="numpy")
def _level(height: np.ndarray, node: int) -> int:
    return height[node] if node >= 0 else 0


@njit(cache=True, error_model="numpy")
def _settle(left: np.ndarray, right: np.ndarray, height: np.ndarray, node: int) -> None:
    height[node] = 1 + max(_level(height, left[node]), _level(height, right[node]))


@njit(cache=True, error_model="numpy")
def _rotate_right(left: np.ndarray, right: np.ndarray, height: np.ndarray, node: int) -> int:
    top: int = left[node]
    left[node] = right[top]
    right[top] = node
    _settle(left, right, height, node)
    _settle(left, right, height, top)
    return top


@njit(cache=True, error_model="numpy")
def _rotate_left(left: np.ndarray, right: np.ndarray, height: np.ndarray, node: int) -> int:
    top: int = right[node]
    right[node] = left[top]
    left[top] = node
    _settle(left, right, height, node)
    _settle(left, right, height, top)
    return top


@njit(cache=True, error_model="numpy")
def _balance(left: np.ndarray, right: np.ndarray, height: np.ndarray, node: int) -> int:
    """Restore balance at a node whose subtrees are balanced; the node that takes its place."""
    tilt = _level(height, left[node]) - _level(height, right[node])
    if tilt > 1:
        child = left[node]
        if _level(height, left[child]) < _level(height, right[child]):
            left[node] = _rotate_left(left, right, height, child)
        return _rotate_right(left, right, height, node)
    if tilt < -1:
        child = right[node]
        if _level(height, right[child]) < _level(height, left[child]):
            right[node] = _rotate_right(left, right, height, child)
        return _rotate_left(left, right, height, node)
    _settle(left, right, height, node)
    return node


@njit(cache=True, error_model="numpy")
def _descend(
    keys: np.ndarray, left: np.ndarray, right: np.ndarray, root: int, time: int, path: np.ndarray
) -> tuple[int, bool]:
    """Way from the root to where `time` is or belongs: its length, and whether it is there."""
    node, depth = root, 0
    while node >= 0:
        path[depth] = node
        depth += 1
        if keys[node] == time:
            return depth, True
        node = left[node] if time < keys[node] else right[node]
    return depth, False


@njit(cache=True, error_model="numpy")
def _retrace(left: np.ndarray, right: np.ndarray, height: np.ndarray, path: np.ndarray, depth: int, root: int) -> int:
    """Restore heights and balance along a path after an insertion at its end; the root."""
    while depth > 0:
        depth -= 1
        node = path[depth]
        before = height[node]
        top = _balance(left, right, height, node)
        if depth == 0:
            root = top
        elif left[path[depth - 1]] == node:
            left[path[depth - 1]] = top
        else:
            right[path[depth - 1]] = top
        if height[top] == before:
            break
    return root


@njit(cache=True, error_model="numpy")
def _insert(
    keys: np.ndarray,
    values: np.ndarray,
    left: np.ndarray,
    right: np.ndarray,
    height: np.ndarray,
    root: int,
    count: int,
    times: np.ndarray,
    frames: np.ndarray,
) -> tuple[int, int]:
    """Insert one by one; the root and the number of nodes afterwards."""
    path = np.empty(_MOST_LEVELS, np.int32)
    for i in range(times.size):
        depth, there = _descend(keys, left, right, root, times[i], path)
        if there:
            continue
        keys[count], values[count] = times[i], frames[i]
        left[count] = right[count] = -1
        height[count] = 1
        if depth == 0:
            root = count
        else:
            parent = path[depth - 1]
            if times[i] < keys[parent]:
                left[parent] = count
            else:
                right[parent] = count
            root = _retrace(left, right, height, path, depth, root)
        count += 1
    return root, count


@njit(cache=True, error_model="numpy")
def _balanced(left: np.ndarray, right: np.ndarray, height: np.ndarray) -> int:
    """Link nodes 0..n-1, in order of their keys, by halving; the root."""
    starts, stops = np.empty(_MOST_LEVELS, np.int64), np.empty(_MOST_LEVELS, np.int64)
    starts[0], stops[0] = 0, left.size
    waiting = 1 if left.size else 0
    while waiting:
        waiting -= 1
        start, stop = starts[waiting], stops[waiting]
        node = (start + stop) >> 1
        height[node] = _bits(stop - start)
        left[node] = right[node] = -1
        if node > start:
            left[node] = (start + node) >> 1
            starts[waiting], stops[waiting] = start, node
            waiting += 1
        if stop > node + 1:
            right[node] = (node + 1 + stop) >> 1
            starts[waiting], stops[waiting] = node + 1, stop
            waiting += 1
    return left.size >> 1 if left.size else -1


@njit(cache=True, error_model="numpy")
def _bits(number: int) -> int:
    bits = 0
    while number:
        bits += 1
        number >>= 1
    return bits


@njit(cache=True, error_model="numpy")
def _find(
    keys: np.ndarray, left: np.ndarray, right: np.ndarray, root: int, times: np.ndarray, tolerance: int
) -> np.ndarray:
    """Nearest node to each time, int32 [n], -1 beyond the tolerance.

    Both neighbours of a time lie on the way down to it, so looking at the way alone finds them (algorithm 2).
    """
    nodes = np.empty(times.size, np.int32)
    for i in range(times.size):
        time, node = times[i], root
        best, distance = -1, np.int64(0)
        while node >= 0:
            away = abs(keys[node] - time)
            if best < 0 or away < distance or (away == distance and keys[node] < keys[best]):
                best, distance = node, away
            if away == 0:
                break
            node = left[node] if time < keys[node] else right[node]
        nodes[i] = best if best >= 0 and distance <= tolerance else -1
    return nodes


@njit(cache=True, error_model="numpy")
def _walk(
    keys: np.ndarray, left: np.ndarray, right: np.ndarray, root: int, count: int, start: int, stop: int
) -> np.ndarray:
    """Nodes with start <= key < stop in order of their keys, int32."""
    nodes, found = np.empty(count, np.int32), 0
    stack, depth, node = np.empty(_MOST_LEVELS, np.int32), 0, root
    while depth or node >= 0:
        while node >= 0:
            if keys[node] >= start:
                stack[depth] = node
                depth += 1
                node = left[node]
            else:
                node = right[node]
        if depth == 0:
            break
        depth -= 1
        node = stack[depth]
        if keys[node] >= stop:
            break
        nodes[found] = node
        found += 1
        node = right[node]
    return nodes[:found].copy()


@njit(cache=True, error_model="numpy")
def _keep_mutual(positions: np.ndarray, residuals: np.ndarray, back: np.ndarray) -> None:
    for i in range(positions.size):
        if positions[i] >= 0 and back[positions[i]] != i:
            positions[i], residuals[i] = -1, 0


@njit(cache=True, error_model="numpy")
def _merge(
    keys: np.ndarray, times: np.ndarray, tolerance: int, tie_later: bool, positions: np.ndarray, residuals: np.ndarray
) -> None:
    at = 0
    for i in range(times.size):
        while at + 1 < keys.size:
            here, there = abs(keys[at] - times[i]), abs(keys[at + 1] - times[i])
            if there > here or (there == here and not tie_later):
                break
            at += 1
        if keys.size and abs(keys[at] - times[i]) <= tolerance:
            positions[i], residuals[i] = at, keys[at] - times[i]
        else:
            positions[i], residuals[i] = -1, 0
