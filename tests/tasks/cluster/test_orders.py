"""What a worker is sent and answers, without a cluster."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

from packuv.fit import gpu_memory
from packuv.fit.gpu_memory import GpuMemory
from packuv.fit.options import FitOptions
from packuv.progress import no_progress
from tasks.artefacts.jobs import JobDiedError, JobError
from tasks.artefacts.recipe import plain, restore
from tasks.artefacts.stage import Needs, Site, Stage, StageJob
from tasks.artefacts.store import Store
from tasks.cluster.orders import Seen, fulfil, offered, order, read, resources
from tests.support.naps import Nap


@dataclass(frozen=True)
class Options:
    device: str = "cpu"


@dataclass(frozen=True, kw_only=True)
class Fit(Stage):
    name, version = "fit", 1
    options: Options | FitOptions

    def build(self, work):
        return {}


@pytest.fixture
def site(tmp_path) -> Site:
    (tmp_path / "capture").mkdir()
    (tmp_path / "capture/cam00.mp4").write_bytes(b"film")
    return Site(tmp_path / "store", tmp_path / "capture", threads=3, memory_bytes=2_000_000_000)


@pytest.fixture
def seen(site) -> dict[str, list[int]]:
    stat = (site.capture / "cam00.mp4").stat()
    return {"cam00.mp4": [stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino]}


def test_an_order_is_done_once_and_the_store_says_so(site, seen):
    stage, heard = Nap(number=1, seconds=0.1), []
    with Store(site.store).in_use() as present:
        asked = order(stage, site, seen, present)
        answers = [fulfil(asked, lambda *values: heard.append(values)) for _ in range(2)]
    store = Store(site.store)
    key = store.key(stage.name, stage.version, stage.settings, stage.sources)
    assert store.holds(key)
    keys = [read(answer, key, Path("log")) for answer in answers]
    assert [(made, made.reused) for made in keys] == [(key, False), (key, True)]
    assert heard


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"version": "0.0.9"}, r"has \d.*, and whoever asks has PackUV 0\.0\.9; .*install the same on all machines"),
        ({"code": "0" * 64}, "has the same version, but other code, and whoever asks"),
        (
            {"present": "/nowhere/store/.in_use/run-x"},
            r"does not see /nowhere/store .* --out must be a folder",
        ),
        ({"capture": "/nowhere"}, r"cannot read /nowhere/cam00\.mp4 \(No such file or directory\); workers need"),
        ({"seen": {"cam00.mp4": [5, 0, 0, 0]}}, r"cam00\.mp4 is another file on .* or was written to since"),
    ],
)
def test_a_worker_that_is_not_fit_for_an_order_says_why(site, seen, change, message):
    with Store(site.store).in_use() as present:
        asked = {**order(Nap(number=1, seconds=0), site, seen, present), **change}
        if "version" in change:
            asked["stage"] = b"what another version writes"
        answer = fulfil(asked)
    key = Store(site.store).key("nap", 1, {}, {})
    with pytest.raises(ValueError, match=message):
        read(answer, key, Path("log"))
    assert list(Store(site.store).keys()) == []


@pytest.mark.parametrize(
    ("error", "kind"),
    [
        (ValueError("cam03 has no frames"), ValueError),
        (FileNotFoundError(2, "no such thing", "cam03.mp4"), FileNotFoundError),
        (OSError(28, "No space left on device", "a.npz"), OSError),
        (MemoryError(), MemoryError),
        (JobDiedError("killed by signal 9", Path("/log")), JobDiedError),
        (JobError("KeyError: x; the traceback is in /log", Path("/log")), JobError),
    ],
)
def test_failures_keep_their_kind_and_words_on_the_way(site, seen, monkeypatch, error, kind):
    def fails(*_, **__):
        raise error

    monkeypatch.setattr("tasks.cluster.orders.make_by_job", fails)
    with Store(site.store).in_use() as present:
        answer = fulfil(order(Nap(number=1, seconds=0), site, seen, present))
    with pytest.raises(kind) as caught:
        read(answer, Store(site.store).key("nap", 1, {}, {}), Path("log"))
    assert type(caught.value) is kind
    assert str(caught.value) == str(error)
    if isinstance(error, OSError):
        assert caught.value.errno == error.errno
    if isinstance(error, JobError):
        assert caught.value.log == error.log


def test_a_file_that_is_touched_shows_between_two_looks(site, seen):
    files = Seen(site.capture, seen)
    before = files.look()
    assert before == seen
    os.chmod(site.capture / "cam00.mp4", 0o600)
    assert files.look() != before


def test_a_stage_says_what_it_needs(site):
    assert Nap(number=1, seconds=0).needs(site) == Needs(1, 1_000_000_000)
    assert Fit(options=Options()).needs(site) == Needs(3, 3_000_000_000)
    on_gpu = Fit(options=Options("cuda")).needs(site)
    assert on_gpu == Needs(3, 3_000_000_000, 1)
    assert offered(resources(on_gpu)) == on_gpu
    assert on_gpu.fits(Needs(4, 3_000_000_000, 1))
    for small in (Needs(2, 9_000_000_000, 1), Needs(4, 2_000_000_000, 1), Needs(4, 9_000_000_000)):
        assert not on_gpu.fits(small)


def test_a_gpu_names_no_artefact_but_its_receipt_says_so(site):
    """A run that loses its GPU goes on with what is there."""
    cpu, cuda = (Fit(options=FitOptions(device=device)) for device in ("cpu", "cuda"))
    store = Store(site.store)
    assert store.key("fit", 1, cpu.settings, {}) == store.key("fit", 1, cuda.settings, {})
    assert store.key("fit", 1, cpu.settings, {}) != store.key("fit", 1, {"options": FitOptions(seed=1)}, {})
    notes = [StageJob(stage, site, Path("out"), Path("scratch"))(no_progress) for stage in (cpu, cuda)]
    assert notes == [{}, {"device": "cuda"}]


@dataclass(frozen=True, kw_only=True)
class Large(Fit):
    """Needs more memory than the GPU has."""

    text: str = "CUDA out of memory. Tried to allocate 9 GiB.\nSee the manual"

    def build(self, work):
        device = self.options.device
        (work.out / device).write_text("here")
        if device == "cuda":
            raise torch.OutOfMemoryError(self.text)
        return {"made": sorted(path.name for path in work.out.iterdir())}


def test_where_the_gpus_memory_is_used_up_the_cpu_goes_on_and_it_is_told(site, tmp_path):
    out = tmp_path / "out"
    (out / "part").mkdir(parents=True)
    notes = StageJob(Large(options=FitOptions(device="cuda")), site, out, tmp_path)(no_progress)
    assert (notes["made"], notes["device"]) == (["cpu"], "cpu")
    assert notes["no_gpu"] == (
        "its memory was used up (CUDA out of memory. Tried to allocate 9 GiB.), so the CPU did it"
    )


@dataclass(frozen=True, kw_only=True)
class Counted(Fit):
    """Needs 5 GB of a GPU, and 1 GB for layers; finds its memory used up as long as it may keep more than `most`."""

    most: int = 10**10

    def gpu_memory(self, work):
        return GpuMemory(5 * 10**9, 10**9)

    def build(self, work):
        on_gpu, kept = self.options.device == "cuda", work.site.memory_bytes
        assert not list(work.out.iterdir())
        (work.out / "left").write_text("here")
        if on_gpu and kept > self.most:
            raise torch.OutOfMemoryError("CUDA out of memory.")
        return {"on_gpu": on_gpu, "kept": kept}


ANEW = "those that do not stay are composed anew for each picture"


@pytest.mark.parametrize(
    ("free", "most", "notes"),
    [
        (9.0, 10**10, {"on_gpu": True, "kept": 2_000_000_000, "device": "cuda"}),
        (5.6, 10**10, {"on_gpu": True, "kept": 500_000_000, "device": "cuda",
                       "less_gpu": f"it has room for 0.5 GB of them; {ANEW}"}),
        (9.0, 0, {"on_gpu": True, "kept": 0, "device": "cuda",
                  "less_gpu": f"its memory was used up (CUDA out of memory.); {ANEW}"}),
        (9.0, -1, {"on_gpu": False, "kept": 2_000_000_000, "device": "cpu",
                   "no_gpu": "its memory was used up (CUDA out of memory.), so the CPU did it"}),
        (4.0, 10**10, {"on_gpu": False, "kept": 2_000_000_000, "device": "cpu",
                       "no_gpu": "it needs 5.0 GB, 4.0 GB are free, so the CPU did it"}),
    ],
    ids=["all", "fewer layers", "no layers after all", "the CPU after all", "the CPU at once"],
)  # fmt: skip
def test_a_fit_keeps_on_the_gpu_what_there_is_room_for(site, tmp_path, monkeypatch, free, most, notes):
    monkeypatch.setattr(gpu_memory, "memory_of_gpu", lambda: (round(free * 1e9), 10**10))
    monkeypatch.setattr(gpu_memory, "_hold", lambda size: True)
    (tmp_path / "out").mkdir()
    stage = Counted(options=FitOptions(device="cuda"), most=most)
    assert StageJob(stage, site, tmp_path / "out", tmp_path)(no_progress) == notes


def test_other_errors_on_a_gpu_are_raised(site, tmp_path):
    with pytest.raises(RuntimeError, match="drawn otherwise"):
        StageJob(Broken(options=Options("cuda")), site, tmp_path, tmp_path)(no_progress)


@dataclass(frozen=True, kw_only=True)
class Broken(Fit):
    def build(self, work):
        raise RuntimeError("drawn otherwise")


def test_the_device_still_travels_with_an_order():
    assert plain(FitOptions(device="cuda"))["device"] == "cuda"
    assert restore(FitOptions, plain(FitOptions(device="cuda"))) == FitOptions(device="cuda")
