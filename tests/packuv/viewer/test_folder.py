"""A scene as static files: both forms give back every integer, and the page draws from them behind any web server."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import http.server
import io
import json
import re
import shutil
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from packuv.camera import PinholeCamera
from packuv.colour import lit
from packuv.gaussians.codes import OPACITY, OPACITY_RANGE, Codes, Quantizer, attribute_count
from packuv.gaussians.segment import Segment
from packuv.raster import RasterOptions, render
from packuv.scene import SceneHeader, open_scene, write_scene
from packuv.scene.mosaic import NEUTRAL
from packuv.viewer.bodies import Bodies
from packuv.viewer.folder import WebOptions, checksum, read_deltas, read_index, read_video, write_web
from packuv.viewer.source import SceneSource, open_source
from packuv.viewer.streams import (
    MOST_PIXELS,
    Sheet,
    StreamWriter,
    WebCodec,
    add_planes,
    code_planes,
    codes_of_planes,
    delta_planes,
    read_stream,
)
from tests.support.browser import Browser, running_browser
from tests.support.viewed import running


def quantizer(degree):
    count = attribute_count(degree)
    low, high = np.full(count, -1.5), np.full(count, 1.5)
    low[:3], high[:3], low[3:6], high[3:6] = -3, -1, -0.71, 0.71
    low[OPACITY], high[OPACITY] = OPACITY_RANGE
    return Quantizer(np.zeros(3), 1.0, np.full(3, 2.0), low, high, degree)


def ring(count=3, width=160, height=120):
    cameras = []
    for index in range(count):
        angle = 2 * np.pi * index / count
        forward = -np.array([np.cos(angle), 0, np.sin(angle)])
        right = np.cross([0, 1.0, 0], forward)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
        pose[2, 3] = 6
        cameras.append(PinholeCamera(f"cam{index}", width, height, 150, 150, width / 2, height / 2, pose))
    return tuple(cameras)


def random_codes(rng, count, degree):
    columns = attribute_count(degree)
    return Codes(rng.integers(0, 65536, (count, 3), np.uint16), rng.integers(1, 256, (count, columns), np.uint8))


def write_random_scene(path, *, degree=0, rows=(500, 300, 7), frames=(3, 2, 1), seed=0, light=None):
    rng = np.random.default_rng(seed)
    parts, first = [], 0
    for number, (count, length) in enumerate(zip(rows, frames, strict=True)):
        key, moving = random_codes(rng, count, degree), count // 3 if length > 1 else 0
        xyz = np.repeat(key.xyz[None, :moving], length - 1, axis=0) + rng.integers(
            0, 999, (length - 1, moving, 3), np.uint16
        )
        attributes = np.repeat(key.attributes[None, :moving], length - 1, axis=0)
        attributes[..., 7:] += rng.integers(0, 9, attributes[..., 7:].shape, np.uint8)
        attributes[:1, : moving // 4, OPACITY] = 0
        parts.append(path.with_name(f"{number}.npz"))
        Segment(first, key, np.arange(count) < moving, xyz, attributes).save(parts[-1])
        first += length
    times = np.array([index * 10**9 // 30 for index in range(first)], dtype=np.int64)
    header = SceneHeader(quantizer(degree), times, Fraction(30), ring(), extra={"near": 0.1})
    write_scene(path, parts, header if light is None else replace(header, light=light))
    return path


@pytest.fixture(scope="module")
def scene_path(tmp_path_factory):
    return write_random_scene(tmp_path_factory.mktemp("web") / "a.mkv")


@pytest.fixture(scope="module")
def sites(scene_path):
    """The same scene by both codecs."""
    folders = {codec: scene_path.with_name(str(codec)) for codec in WebCodec}
    for codec, folder in folders.items():
        write_web(scene_path, folder, options=WebOptions(codec))
    return folders


def same(a, b):
    return np.array_equal(a.xyz, b.xyz) and np.array_equal(a.attributes, b.attributes)


# Pictures


@settings(max_examples=25)
@given(st.integers(1, 3000), st.integers(1, 70), st.integers(0, 2**32 - 1))
def test_a_picture_holds_every_byte_once(capacity, planes, seed):
    sheet = Sheet.of(capacity, planes)
    count = np.random.default_rng(seed).integers(0, capacity + 1)
    rows = np.random.default_rng(seed).integers(0, 256, (planes, count), np.uint8)
    cells = sheet.cells(capacity)
    assert len(np.unique(cells)) == cells.size
    picture = sheet.draw(rows)
    assert np.array_equal(sheet.read(picture, count), rows)
    picture.reshape(-1)[sheet.cells(count)] = NEUTRAL
    assert (picture == NEUTRAL).all()
    assert picture.shape[0] % 16 == picture.shape[1] % 16 == 0


def test_pictures_stay_within_what_browsers_decode():
    largest = Sheet.of(300_000, 6 + attribute_count(3))
    assert max(largest.width, largest.height) <= MOST_PIXELS
    with pytest.raises(ValueError, match="fit fewer Gaussians or a lower SH degree"):
        Sheet.of(20_000_000, 61)


@settings(max_examples=60)
@given(st.integers(0, 40), st.integers(0, 2), st.integers(0, 2**32 - 1))
def test_bytes_of_rows_add_up(count, degree, seed):
    rng = np.random.default_rng(seed)
    now, last = random_codes(rng, count, degree), random_codes(rng, count, degree)
    assert same(codes_of_planes(code_planes(now)), now)
    assert same(add_planes(last, delta_planes(now, last)), now)
    assert (delta_planes(now, now) == NEUTRAL).all()


@pytest.mark.parametrize("codec", list(WebCodec))
def test_streams_give_back_every_byte_and_name_their_packets(codec):
    rng = np.random.default_rng(0)
    sheet, file = Sheet.of(700, 16), io.BytesIO()
    pictures = [rng.integers(0, 256, (16, 700), np.uint8) for _ in range(3)]
    pictures += [pictures[-1].copy() for _ in range(3)]
    pictures[-1][3, :50] += 1
    writer = StreamWriter(file, sheet, codec, Fraction(30))
    for number, planes in enumerate(pictures):
        writer.add(planes, starts=number in (0, 3))
    writer.close()
    decoded = list(read_stream(file, writer.to_json(), codec))
    assert len(decoded) == 6
    for picture, planes in zip(decoded, pictures, strict=True):
        assert np.array_equal(picture, sheet.draw(planes))
    assert writer.keys == [0, 3]
    assert re.fullmatch(r"vp09\.00\.\d\d\.08|av01\.0\.\d\dM\.08", writer.codec_string)
    data = file.getvalue()
    assert data[:4] == b"DKIF"
    assert int.from_bytes(data[24:28], "little") == 6
    for (offset, size), after in zip(
        writer.packets, [*(o - 12 for o, _ in writer.packets[1:]), len(data)], strict=True
    ):
        assert offset + size == after
        assert int.from_bytes(data[offset - 12 : offset - 8], "little") == size


# Folders


@pytest.mark.parametrize("codec", list(WebCodec))
def test_both_forms_give_back_every_frame(scene_path, sites, codec):
    with open_scene(scene_path) as scene:
        checks, bodies = json.loads((sites[codec] / "video.json").read_text())["crc32"], Bodies(SceneSource(scene))
        forms = zip(read_video(sites[codec]), read_deltas(sites[codec]), strict=True)
        for frame, (video, deltas) in enumerate(forms):
            truth = scene.codes(frame)
            assert same(video, truth)
            assert same(deltas, bodies.codes(frame))
            assert checks[frame] == checksum(truth)
        assert frame == 5


@pytest.mark.parametrize("shape", [{"rows": (40,), "frames": (1,)}, {"degree": 3, "rows": (90,), "frames": (2,)}])
def test_a_scene_in_which_nothing_moves_and_one_with_high_bands(tmp_path, shape):
    scene = write_random_scene(tmp_path / "a.mkv", **shape)
    summary = write_web(scene, tmp_path / "a", options=WebOptions())
    assert summary.frames == sum(shape["frames"])
    with open_scene(scene) as opened:
        assert all(same(codes, opened.codes(frame)) for frame, codes in enumerate(read_video(tmp_path / "a")))


def test_the_folder_is_whole_or_absent(scene_path, sites, tmp_path):
    steps = []
    summary = write_web(scene_path, tmp_path / "a", options=WebOptions(), progress=lambda *step: steps.append(step))
    assert steps[-1] == (24, 24)
    assert summary.bytes == sum(path.stat().st_size for path in (tmp_path / "a").iterdir())
    with pytest.raises(FileExistsError, match="must be new or an empty folder"):
        write_web(scene_path, tmp_path / "a", options=WebOptions())
    with pytest.raises(FileNotFoundError):
        write_web(tmp_path / "none.mkv", tmp_path / "b", options=WebOptions())
    assert [path.name for path in tmp_path.iterdir()] == ["a"]
    for name in ("index.json", "key.ivf", "delta.ivf", "segment00000.bin", "scene.json", "video.json"):
        assert (tmp_path / "a" / name).read_bytes() == (
            sites[WebCodec.VP9] / name
        ).read_bytes()  # same scene, same bytes


@pytest.mark.parametrize("file", ["segment00000.bin", "delta.ivf"])
def test_damage_is_told(sites, tmp_path, file):
    folder = shutil.copytree(sites[WebCodec.VP9], tmp_path / "a")
    content = (folder / file).read_bytes()
    (folder / file).write_bytes(content[:60] + bytes(len(content) - 60))
    read = read_deltas if file.startswith("segment") else read_video
    try:
        before = zip(read(sites[WebCodec.VP9]), read(folder), strict=True)
        wrong = [frame for frame, pair in enumerate(before) if not same(*pair)]
    except (ValueError, OSError) as error:
        wrong = [str(error)]
    assert wrong
    (folder / "index.json").write_text("{}")
    with pytest.raises(ValueError, match="no index of a scene"):
        read_index(folder)


def test_only_a_scene_whose_light_changes_says_so(sites, tmp_path):
    light = np.linspace(-0.5, 0.5, 18).reshape(6, 3).round(5)
    write_web(write_random_scene(tmp_path / "a.mkv", light=light), tmp_path / "a", options=WebOptions())
    told, plain = (json.loads((folder / "scene.json").read_text()) for folder in (tmp_path / "a", sites[WebCodec.VP9]))
    assert np.array_equal(told.pop("light"), light)
    assert told == plain
    for name in ("index.json", "key.ivf", "delta.ivf", "segment00000.bin", "video.json"):
        assert (tmp_path / "a" / name).read_bytes() == (sites[WebCodec.VP9] / name).read_bytes()  # codes are steady


# In a browser


class _Handler(http.server.SimpleHTTPRequestHandler):
    """Static files, with byte ranges if `ranges`; notes what was asked for."""

    ranges = True
    asked: list[str]

    def do_GET(self) -> None:
        wanted = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
        self.asked.append(self.path + (" range" if wanted else ""))
        if not wanted or not self.ranges:
            return super().do_GET()
        first, last = map(int, wanted.groups())
        body = Path(self.translate_path(self.path)).read_bytes()[first : last + 1]
        self.send_response(206)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        pass


@contextlib.contextmanager
def served(folder: Path, *, ranges: bool) -> Iterator[tuple[str, list[str]]]:
    asked: list[str] = []
    kind = type("Handler", (_Handler,), {"ranges": ranges, "asked": asked})
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(kind, directory=str(folder))) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}/", asked
        finally:
            server.shutdown()
            thread.join()


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with running_browser(tmp_path_factory.mktemp("profile")) as started:
        yield started


@pytest.mark.slow
@pytest.mark.parametrize("ranges", [True, False])
def test_the_page_draws_the_scene_behind_any_web_server(browser, scene_path, sites, ranges):
    camera, background = ring()[1], (0.2, 0.4, 0.6)
    wish = f"#bare=1&play=0&frame=4&camera={camera.name}&background={','.join(map(str, background))}"
    with served(sites[WebCodec.VP9], ranges=ranges) as (address, asked):
        browser.open(address + wish, camera.width, camera.height)
        browser.wait_for("document.documentElement.dataset.frame == 4")
        shown = browser.picture().astype(np.float64) / 255
    with open_scene(scene_path) as scene:
        wanted = render(scene.gaussians(4), camera, options=RasterOptions(near=0.1), background=background).colour
    error = shown - np.clip(wanted.transpose(1, 2, 0), 0, 1)
    # 8 bits alone allow 59 dB; half floats and depth ties inside 1/4096 take the rest, as in the viewer's own tests.
    assert -10 * np.log10(np.mean(error**2)) > 50
    assert wanted.std() > 0.1
    names = [f"/segment0000{number}.bin" for number in range(3)]
    if ranges:
        assert not set(names) & set(asked)  # nothing whole
    else:
        assert all(asked.count(name) <= 1 for name in names)  # each whole file once, whoever asks
        assert sum("range" in path for path in asked) == 1  # to find out


@pytest.mark.slow
def test_the_page_in_a_folder_shows_a_frame_in_its_light(browser, tmp_path):
    light = np.zeros((6, 3))
    light[4] = [0.6, 0, -0.8]
    path, camera = write_random_scene(tmp_path / "a.mkv", rows=(4000, 4000, 7), light=light), ring()[1]
    write_web(path, tmp_path / "a", options=WebOptions())
    with served(tmp_path / "a", ranges=True) as (address, _):
        browser.open(
            f"{address}#bare=1&play=0&frame=4&camera={camera.name}&background=0,0,0", camera.width, camera.height
        )
        browser.wait_for("document.documentElement.dataset.frame == 4")
        shown = browser.picture().astype(np.float64).transpose(2, 0, 1) / 255
    with open_scene(path) as scene:
        drawn = render(scene.gaussians(4), camera, options=RasterOptions(near=0.1))
        wanted = np.clip(lit(drawn.colour, scene.light(4)), 0, 1)  # what `packuv render` writes
    covered = drawn.alpha > 0.99
    assert covered.mean() > 0.2
    assert -10 * np.log10(np.mean((shown - wanted)[:, covered] ** 2)) > 50  # as in steady light
    assert -10 * np.log10(np.mean((shown - np.clip(drawn.colour, 0, 1))[:, covered] ** 2)) < 30


SUMS = """
(async () => {
  const video = await (await fetch("video.json")).json(), sums = {};
  for (const name of ["key", "delta"]) {
    const stream = video[name], bytes = await (await fetch(stream.file)).arrayBuffer(), pictures = [];
    const fail = (error) => { window.sums = String(error); };
    const decoder = new VideoDecoder({ error: fail, output: (frame) => pictures.push(sum(frame, stream)) });
    decoder.configure({ codec: stream.codec, codedWidth: stream.width, codedHeight: stream.height });
    stream.packets.forEach(([offset, size], number) => decoder.decode(new EncodedVideoChunk({
      type: stream.keys.includes(number) ? "key" : "delta", timestamp: number * 1000,
      data: new Uint8Array(bytes, offset, size),
    })));
    await decoder.flush();
    sums[name] = await Promise.all(pictures);
  }
  window.sums = JSON.stringify(sums);

  async function sum(frame, { width, height }) {
    const copied = new Uint8Array(frame.allocationSize());
    const [{ offset, stride }] = await frame.copyTo(copied);
    const luma = new Uint8Array(width * height);
    for (let y = 0, at = offset; y < height; y++, at += stride) luma.set(copied.subarray(at, at + width), y * width);
    frame.close();
    const digest = new Uint8Array(await crypto.subtle.digest("SHA-256", luma));
    return [...digest].map((byte) => byte.toString(16).padStart(2, "0")).join("");
  }
})().catch((error) => { window.sums = String(error); });
"""


@pytest.mark.slow
@pytest.mark.parametrize("codec", list(WebCodec))
def test_chromium_decodes_the_streams_bit_by_bit(browser, sites, codec):
    video = json.loads((sites[codec] / "video.json").read_text())
    wanted = {}
    for name in ("key", "delta"):
        with (sites[codec] / video[name]["file"]).open("rb") as file:
            pictures = read_stream(file, video[name], codec)
            wanted[name] = [hashlib.sha256(picture.tobytes()).hexdigest() for picture in pictures]
    assert (len(wanted["key"]), len(wanted["delta"])) == (3, 3)
    with served(sites[codec], ranges=True) as (address, _):
        browser.open(address + "#play=0", 160, 120)
        browser.evaluate(SUMS)
        browser.wait_for("window.sums")
        assert json.loads(browser.evaluate("window.sums")) == wanted


@pytest.mark.slow
@pytest.mark.parametrize("ranges", [True, False])
def test_damaged_bytes_of_a_folder_cost_their_frame(browser, sites, tmp_path, ranges):
    site = shutil.copytree(sites[WebCodec.VP9], tmp_path / "site")
    entry = read_index(site)["segments"][1]  # frames 3 and 4
    body = bytearray((site / entry["file"]).read_bytes())
    body[-entry["frames"][-1] // 2] ^= 0x55
    (site / entry["file"]).write_bytes(body)
    with served(site, ranges=ranges) as (address, _):
        browser.open(address + "#play=0&frame=3", 160, 120)
        browser.wait_for("document.documentElement.dataset.lost == 1 && document.documentElement.dataset.frame == 3")
        assert browser.evaluate("document.getElementById('wait').hidden")


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["colour", "depth", "dynamic", "opacity", "map", "layer"])
def test_a_folder_shows_what_the_viewer_shows_in_every_mode(browser, scene_path, sites, mode):
    wish, pictures = f"#bare=1&play=0&frame=1&camera=cam1&mode={mode}", []
    with open_source(scene_path) as source, running(source) as server, served(sites[WebCodec.VP9], ranges=True) as site:
        for address in (server.url, site[0]):
            browser.open(address + wish, 160, 120)
            browser.wait_for("document.documentElement.dataset.frame == 1")
            if mode == "layer":
                browser.wait_for("document.documentElement.dataset.layers == 0")
            time.sleep(0.5)  # drawn
            pictures.append(browser.picture())
    assert np.array_equal(*pictures)
    assert pictures[0].std() > 5
