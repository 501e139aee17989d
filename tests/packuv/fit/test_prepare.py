"""What frames are fitted to, made ready while the frame before is fitted: the same as without, and nothing is left."""

from __future__ import annotations

import threading
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
import torch

from packuv.budget import Budget
from packuv.fit.prepare import Instant, prepared
from packuv.fit.shots import Sent, find_shots
from packuv.footage import FrameReader, LensCamera, Views
from packuv.motion import MotionCache, MotionOptions, measure_motion
from packuv.raster.cuda import launch

ROWS = range(1, 5)
CAMERAS = 4
WAIT_SECONDS = 20.0
"""For what threads do at once, on a busy machine too"""


@pytest.fixture(scope="module")
def videos(ring, tmp_path_factory) -> dict[str, Path]:
    """A square that moves over noise; the last camera sees nothing move."""
    folder, rng = tmp_path_factory.mktemp("videos"), np.random.default_rng(0)
    made = {}
    for number, camera in enumerate(ring(CAMERAS)):
        made[camera.name] = folder / f"{camera.name}.mkv"
        noise = rng.integers(60, 90, (camera.height, camera.width, 3), dtype=np.uint8)
        with av.open(str(made[camera.name]), "w") as container:
            stream = container.add_stream("ffv1", rate=30)
            stream.width, stream.height, stream.pix_fmt = camera.width, camera.height, "bgr0"
            for row in range(ROWS.stop):
                picture = noise.copy()
                if number < CAMERAS - 1:
                    picture[20:40, 10 + 8 * row : 30 + 8 * row] = 220
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
            container.mux(stream.encode())
    return made


def open_views(videos, ring, reader: FrameReader | None = None, **given) -> Views:
    frames = np.tile(np.arange(ROWS.stop)[:, None], (1, CAMERAS))
    frames[3, 1] = -1  # one camera drops a frame
    return Views(videos, frames, [LensCamera(camera) for camera in ring(CAMERAS)], reader=reader, **given)


@pytest.fixture(scope="module")
def motion(videos, ring, tmp_path_factory) -> MotionCache:
    options = MotionOptions(width=96, flow_width=48, least_area_px=4, closing_px=1, dilation_px=1)
    folder = tmp_path_factory.mktemp("motion")
    measure_motion(open_views(videos, ring), folder, options=options)
    return MotionCache.load(folder)


class Gpu:
    """In place of one: what was sent, and the threads that sent it."""

    def __init__(self) -> None:
        self.count, self.threads = 0, set[str]()
        self._more = threading.Condition()

    def send(self, array: np.ndarray) -> Sent:
        copy = array.copy()
        with self._more:
            self.count += 1
            self.threads.add(threading.current_thread().name)
            self._more.notify_all()
        return lambda: copy

    def has(self, count: int) -> bool:
        """Whether so many pictures come, without anybody asking for one."""
        with self._more:
            return self._more.wait_for(lambda: self.count >= count, WAIT_SECONDS)


class Watched(FrameReader):
    """Notes who reads what."""

    def __init__(self, videos) -> None:
        super().__init__(videos)
        self.read_frames: dict[str, list[int]] = {name: [] for name in videos}

    def read(self, camera: str, frame: int) -> np.ndarray:
        self.read_frames[camera].append(frame)
        return super().read(camera, frame)


def ours() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name.startswith("packuv-prepare")]


def needed(motion: MotionCache, views: Views, row: int) -> list[int]:
    """Cameras that have a picture, and in which something moves or nobody knows."""
    masks = [motion.mask(index, row) for index in range(CAMERAS)]
    return [k for k, mask in enumerate(masks) if views.has(k, row) and (mask is None or mask.any())]


@pytest.mark.parametrize("workers", [1, 3])
def test_instants_prepared_ahead_are_those_prepared_when_they_are_asked_for(videos, ring, motion, workers):
    views, gpu = open_views(videos, ring), Gpu()
    given = {"flows": True, "workers": workers}
    with prepared(views, motion, ROWS, send=None, **given) as plain:
        truth = list(plain)
    with prepared(open_views(videos, ring), motion, ROWS, send=gpu.send, **given) as coming:
        found = list(coming)
    assert [instant.row for instant in found] == [instant.row for instant in truth] == list(ROWS)
    for one, other in zip(found, truth, strict=True):
        assert_same(one.masks, other.masks)
        assert_same(one.optical_flows, other.optical_flows)
        wanted = needed(motion, views, one.row)
        assert 0 < len(wanted) < CAMERAS
        assert [k for k, sent in enumerate(one.sent) if sent] == wanted
        assert other.sent == [None] * CAMERAS
        for k in wanted:
            assert np.array_equal(one.sent[k](), views.pixels(k, one.row))
    assert not any(name == threading.current_thread().name for name in gpu.threads)


def assert_same(ones, others) -> None:
    for one, other in zip(ones, others, strict=True):
        assert (one is None) == (other is None)
        assert one is None or np.array_equal(one, other)


def test_the_next_instant_comes_while_one_is_fitted_and_no_more_than_that(videos, ring, motion):
    reader, gpu = Watched(videos), Gpu()
    views = open_views(videos, ring, reader, budget=Budget(1000))  # not room for one picture
    by_row = [len(needed(motion, views, row)) for row in ROWS]
    with prepared(views, motion, ROWS, flows=False, send=gpu.send, workers=2) as coming:
        for place, _ in enumerate(coming):
            assert gpu.has(sum(by_row[: place + 2]))
            assert gpu.count == sum(by_row[: place + 2])
            assert views.budget.free_bytes == 1000
    assert all(frames == sorted(set(frames)) for frames in reader.read_frames.values())
    assert not ours()


def test_a_segment_of_a_keyframe_alone_prepares_nothing(videos, ring, motion):
    with prepared(open_views(videos, ring), motion, [], flows=False, send=Gpu().send, workers=2) as coming:
        assert not list(coming)
    assert not ours()


class Breaking(Watched):
    """Its first camera ends early."""

    def read(self, camera: str, frame: int) -> np.ndarray:
        if camera == min(self.videos) and frame == 2:
            raise ValueError(f"frame {frame} cannot be decoded")
        return super().read(camera, frame)


def test_a_picture_that_cannot_be_read_says_so_where_it_is_needed(videos, ring, motion):
    views, found = open_views(videos, ring, Breaking(videos)), list[Instant]()
    with prepared(views, motion, ROWS, flows=False, send=Gpu().send, workers=2) as coming:
        found.extend(coming)
    assert [instant.sent[0] is None for instant in found] == [False, True, False, False]
    shots = find_shots(views, 2, found[1].masks, found[1].sent)
    assert [shot.sent is None for shot in shots] == [True, False, False]
    with pytest.raises(ValueError, match=r"^frame 2 cannot be decoded$"):
        shots[0].filmed  # noqa: B018  # it reads


def test_a_picture_that_cannot_be_sent_is_sent_by_who_needs_it_and_not_read_again(videos, ring, motion):
    reader, gpu = Watched(videos), Gpu()
    views = open_views(videos, ring, reader)

    def full(array: np.ndarray) -> Sent:
        if threading.current_thread().name.startswith("packuv-prepare"):
            raise torch.OutOfMemoryError("CUDA out of memory.")
        return gpu.send(array)

    with prepared(views, motion, range(1, 2), flows=False, send=full, workers=2) as coming:
        (instant,) = coming
    read = sum(map(len, reader.read_frames.values()))
    wanted = needed(motion, views, 1)
    for k in wanted:
        sent = instant.sent[k]
        assert sent is not None
        assert np.array_equal(sent(), open_views(videos, ring).pixels(k, 1))
    assert sum(map(len, reader.read_frames.values())) == read
    assert gpu.count == len(wanted)


def test_a_mask_that_cannot_be_read_ends_it_with_its_own_sentence(videos, ring, motion, monkeypatch):
    def broken(self, camera, instant):
        if instant == 3:
            raise OSError("the disk is gone")

    monkeypatch.setattr(MotionCache, "mask", broken)
    rows = list[int]()

    def fit() -> None:
        with prepared(open_views(videos, ring), motion, ROWS, flows=False, send=Gpu().send, workers=2) as coming:
            rows.extend(instant.row for instant in coming)

    with pytest.raises(OSError, match=r"^the disk is gone$"):
        fit()
    assert rows == [1, 2]
    assert not ours()


def test_an_interrupt_waits_for_what_is_under_way_only(videos, ring, motion):
    """A picture is under way when the fit ends; those behind it are not begun."""
    reading, go_on = threading.Event(), threading.Event()

    class Slow(Watched):
        def read(self, camera: str, frame: int) -> np.ndarray:
            if frame == 2:
                reading.set()
                assert go_on.wait(WAIT_SECONDS)
            return super().read(camera, frame)

    reader, gpu = Slow(videos), Gpu()

    def fit() -> None:
        with prepared(open_views(videos, ring, reader), motion, ROWS, flows=False, send=gpu.send, workers=1) as coming:
            next(coming)
            assert reading.wait(WAIT_SECONDS)
            threading.Timer(0.2, go_on.set).start()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit()
    assert sum(2 in frames for frames in reader.read_frames.values()) == 1
    assert not ours()


def test_a_picture_travels_beside_the_kernels_which_wait_for_it(monkeypatch):
    """With torch's streams replaced, since no GPU is here: what is asked of which, in order."""
    asked = list[str]()

    class Stream:
        def __init__(self, name: str) -> None:
            self.name = name

        def record_event(self) -> str:
            asked.append(f"an event of {self.name}")
            return f"event of {self.name}"

        def wait_stream(self, other: Any) -> None:
            asked.append(f"{self.name} wait for {other.name}")

        def wait_event(self, event: str) -> None:
            asked.append(f"{self.name} waits for {event}")

    @contextmanager
    def on(stream: Stream):
        asked.append(f"to {stream.name}")
        yield
        asked.append(f"from {stream.name}")

    def empty(shape, *, dtype, device):
        asked.append(f"memory of {device}")
        return torch.zeros(tuple(shape), dtype=dtype)

    def copy(tensor, source, *, non_blocking: bool):
        asked.append(f"copy {'without' if non_blocking else 'with'} waiting")
        tensor[:] = source

    kernels, aside = Stream("kernels"), Stream("copies")
    monkeypatch.setattr(launch, "MEMORY", torch.device("cuda"))
    monkeypatch.setattr(launch, "_aside", lambda: aside)
    monkeypatch.setattr(torch.cuda, "stream", on)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda: kernels)
    monkeypatch.setattr(torch.Tensor, "pin_memory", lambda tensor: asked.append("pin") or tensor)
    monkeypatch.setattr(torch, "empty", empty)
    monkeypatch.setattr(torch.Tensor, "copy_", copy)
    monkeypatch.setattr(torch.Tensor, "record_stream", lambda tensor, stream: asked.append(f"kept for {stream.name}"))
    pixels = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)
    taken = launch.send(pixels)
    travel = ["pin", "memory of cuda", "copies wait for kernels", "to copies", "copy without waiting"]
    travel += ["an event of copies", "from copies", "kept for copies"]
    assert asked == travel
    assert np.array_equal(taken().numpy(), pixels)
    assert asked[len(travel) :] == ["kernels waits for event of copies"]
