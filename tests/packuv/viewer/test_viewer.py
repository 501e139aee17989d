"""The viewer: what the server sends decodes to the very codes, and the page draws what the rasterizer draws."""

from __future__ import annotations

import contextlib
import http.client
import json
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.request
import zlib
from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from packuv.camera import PinholeCamera
from packuv.colour import lit
from packuv.film import CameraPath
from packuv.gaussians.codes import OPACITY, OPACITY_RANGE, Codes, attribute_count
from packuv.gaussians.floats import Gaussians
from packuv.gaussians.segment import Segment
from packuv.gaussians.uvmap import assign_slots
from packuv.gaussians.uvsize import UvOptions
from packuv.raster import RasterOptions, render
from packuv.scene import SceneHeader, open_scene, write_scene
from packuv.viewer import serve
from packuv.viewer import server as viewer_server
from packuv.viewer.bodies import PART_ROWS, SPAN, Bodies, importance, parents
from packuv.viewer.server import MOST_CONNECTIONS, PAGES, ViewerServer
from packuv.viewer.source import (
    SegmentSource,
    Source,
    describe,
    near_plane,
    open_source,
)
from tests.support.browser import Browser, running_browser
from tests.support.page import Page, tables_of
from tests.support.viewed import make_quantizer, make_ring, make_segment, make_source, running

NEAR = RasterOptions(near=0.1)
PAGE_FOLDER = Path(viewer_server.__file__).parent


def page_of(source: Source) -> Page:
    """What a page makes of the bodies of a source."""
    bodies = Bodies(source)

    def get(address: str) -> bytes:
        what, *numbers = address.removesuffix(".bin").split("/")
        make = {"segments": bodies.part, "frames": bodies.frame}[what]
        return zlib.decompress(make(*map(int, numbers)))

    return Page(describe(source), get)


def assert_same_rows(left: Codes, right: Codes) -> None:
    """In any order."""
    rows = [np.concatenate([codes.xyz, codes.attributes], axis=1) for codes in (left, right)]
    assert np.array_equal(*(row[np.lexsort(row.T)] for row in rows))


def assert_same(left: Codes, right: Codes) -> None:
    assert np.array_equal(left.xyz, right.xyz)
    assert np.array_equal(left.attributes, right.attributes)


# ---- bytes


@settings(max_examples=40)
@given(
    seed=st.integers(0, 2**32 - 1),
    lengths=st.lists(st.integers(1, 4), min_size=1, max_size=3),
    count=st.integers(1, 40),
    dynamic=st.sampled_from([0.0, 0.3, 1.0]),
    sh_degree=st.integers(0, 3),
)
def test_what_is_sent_decodes_to_the_codes(
    seed: int, lengths: list[int], count: int, dynamic: float, sh_degree: int
) -> None:
    rng, columns, instant = np.random.default_rng(seed), attribute_count(sh_degree), 17
    parts = []
    for length in lengths:
        parts.append(make_segment(rng, instant, length=length, count=count, dynamic=dynamic, columns=columns))
        instant += length
    source = SegmentSource(tuple(parts), make_quantizer(sh_degree))
    page, bodies = page_of(source), Bodies(source)
    for frame, codes in enumerate(part.frame(offset) for part in parts for offset in range(len(part))):
        got = page.frame(frame)
        assert_same_rows(got, codes)
        assert_same(got, bodies.codes(frame))
    for number, part in enumerate(parts):
        assert page.key(number)[1] == part.dynamic.sum()


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 60), sh_degree=st.integers(0, 2))
def test_rows_that_an_earlier_key_has_are_taken_from_there(seed: int, count: int, sh_degree: int) -> None:
    """Rows that stay still, begin to move, cease to, and are gone, through two references; some are equal."""
    rng, columns, parts = np.random.default_rng(seed), attribute_count(sh_degree), []
    for number in range(3):
        part = make_segment(rng, 2 * number, length=2, count=count, dynamic=0.4, columns=columns)
        if number:
            kept = rng.random(count) < 0.7
            part.key.xyz[kept], part.key.attributes[kept] = parts[-1].key.xyz[kept], parts[-1].key.attributes[kept]
            part.key.xyz[:2], part.key.attributes[:2] = part.key.xyz[:1], part.key.attributes[:1]
        parts.append(part)

    class Shared(SegmentSource):
        def reference(self, segment: int) -> int | None:
            return segment - 1 if segment else None

    page = page_of(Shared(tuple(parts), make_quantizer(sh_degree)))
    for frame in (5, 0, 2, 3, 4, 1):
        assert_same_rows(page.frame(frame), parts[frame // 2].frame(frame % 2))


@pytest.mark.parametrize("length", range(1, 40))
def test_a_frame_needs_few_others_and_few_need_it(length: int) -> None:
    def way(offset: int) -> set[int]:
        return {offset}.union(*(way(parent) for parent in parents(offset, length)))

    ways = [way(offset) for offset in range(length)]
    assert max(map(len, ways)) <= 6  # the key, two that need it alone, and two steps of halving before its own
    for offset in range(1, length):
        heirs = [heir for heir in range(length) if offset in ways[heir]]
        assert max(abs(heir - offset) for heir in heirs) < SPAN
    alone = [offset for offset in range(1, length) if sum(offset in known for known in ways) == 1]
    assert len(alone) >= (length - 1) // 3


def test_what_moves_comes_first_and_then_what_is_large_and_opaque() -> None:
    source = make_source(1, count=40000, dynamic=0.45)
    bodies, page = Bodies(source), page_of(source)
    codes, dynamic = page.key(0)
    weights = importance(codes, source.quantizer)[dynamic:]
    assert dynamic == source.parts[0].dynamic.sum()
    turns = [weights[start : start + PART_ROWS] for start in range(0, len(weights), PART_ROWS)]
    assert len(turns) == 2
    assert turns[0].min() >= turns[1].max()
    assert bodies.parts(0) == -(-dynamic // PART_ROWS) + len(turns) + 1  # the band of view dependence last
    sizes = [len(bodies.part(0, number)) for number in range(bodies.parts(0))]
    assert sizes[0] < 1.05 * PART_ROWS * 16
    with pytest.raises(IndexError):
        bodies.part(0, len(sizes))


def test_bodies_are_made_once() -> None:
    class Counted(SegmentSource):
        asked = 0

        def moving(self, frame: int) -> Codes:
            Counted.asked += 1
            return super().moving(frame)

    bodies = Bodies(Counted(make_source().parts, make_quantizer()))
    first = bodies.frame(2)
    asked = Counted.asked
    assert bodies.frame(2) is first
    assert Counted.asked == asked


def test_a_damaged_frame_of_a_file_costs_no_other_its_prediction() -> None:
    """Frame 8 is what 1 to 7 and 9 to 15 are predicted from, if it can be read."""

    class Damaged(SegmentSource):
        def moving(self, frame: int) -> Codes:
            if frame == 8:
                raise ValueError("packet 7 is damaged")
            return super().moving(frame)

    part = make_segment(np.random.default_rng(1), 0, length=18, count=30, dynamic=0.5, columns=10)
    source = Damaged((part,), make_quantizer())
    page = page_of(source)
    for frame in range(18):
        if frame != 8:
            assert_same_rows(page.frame(frame), part.frame(frame))
    with pytest.raises(ValueError, match="packet 7"):
        page.frame(8)


def test_the_page_rebuilds_the_quantizers_tables() -> None:
    for reach, unit in ((2.0, 1.0), (0.3, 7.0), (9e4, 1e-3)):
        quantizer = replace(make_quantizer(1), reach=np.full(3, reach) * [1, 1.3, 0.9], unit=unit)
        told = json.loads(json.dumps(describe(replace(make_source(1), quantizer=quantizer))))
        positions, attributes = tables_of(told)
        assert np.array_equal(positions, quantizer.xyz_table)
        assert np.array_equal(attributes, quantizer.attribute_table)
        assert len(told["tables"]["except"]) < 1000  # most where the centre lies at the very end of an axis


def test_segments_must_follow_one_another() -> None:
    source = make_source()
    with pytest.raises(ValueError, match="one ends at 4, the next begins at 5"):
        replace(source, parts=(source.parts[0], source.parts[2]))
    with pytest.raises(ValueError, match="fit one first"):
        replace(source, parts=())


def test_the_near_plane_is_the_scenes_own_or_scales_with_the_rig() -> None:
    source = make_source()
    assert near_plane(replace(source, near=0.25)) == 0.25
    assert near_plane(source) == pytest.approx(0.02 * 5.0, rel=0.02)  # the ring's radius, its height aside
    assert near_plane(replace(source, cameras=())) == 0.02 * source.quantizer.unit


# ---- scene files


@pytest.fixture(scope="module")
def scene_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, source = tmp_path_factory.mktemp("scene"), make_source(1)
    paths = []
    for number, part in enumerate(source.parts):
        paths.append(folder / f"{number}.npz")
        part.save(paths[-1])
    header = SceneHeader(
        source.quantizer, source.times_ns, source.rate, source.cameras, ("cam2",), extra={"near": 0.125}
    )
    write_scene(folder / "scene.mkv", paths, header)
    return folder / "scene.mkv"


@pytest.mark.parametrize("order", [(0, 1, 2, 3, 4, 5, 6, 7), (7, 6, 5, 4, 3, 2, 1, 0), (3, 1, 6, 0, 2, 7, 5, 4)])
def test_a_scene_file_gives_its_codes_in_any_order(scene_path: Path, order: tuple[int, ...]) -> None:
    with open_source(scene_path) as source, open_scene(scene_path) as scene:
        page = page_of(source)
        for frame in order:
            assert_same_rows(page.frame(frame), scene.codes(frame))


def test_a_scene_file_describes_itself_like_its_segments(scene_path: Path) -> None:
    with open_source(scene_path) as source:
        told = describe(source)
        wanted = describe(replace(make_source(1), name="scene.mkv", near=0.125))
    assert told == wanted


def test_serve_refuses_what_is_no_scene(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        serve(tmp_path / "none.mkv")
    (tmp_path / "text.mkv").write_text("not a scene")
    with pytest.raises(ValueError, match=r"text\.mkv"):
        serve(tmp_path / "text.mkv")


def test_serve_answers_until_it_is_interrupted(scene_path: Path) -> None:
    program = (
        "import signal, sys; from pathlib import Path; from packuv.viewer import serve; "
        "signal.signal(signal.SIGINT, signal.default_int_handler); "  # a job in the background is born deaf to it
        "serve(Path(sys.argv[1]))"
    )
    command = [sys.executable, "-c", program, str(scene_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout
        url = process.stdout.readline().strip()
        with urllib.request.urlopen(f"{url}scene.json", timeout=10) as answer:
            assert json.load(answer)["name"] == "scene.mkv"
        process.send_signal(signal.SIGINT)
        assert process.wait(10) == 0


# ---- server


def fetch(
    server: ViewerServer, path: str, *, method: str = "GET", **headers: str
) -> tuple[http.client.HTTPResponse, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", server.server_address[1], timeout=10)
    with contextlib.closing(connection):
        connection.request(method, path, headers=headers)
        answer = connection.getresponse()
        body = answer.read()
    return answer, zlib.decompress(body) if answer.getheader("Content-Encoding") == "deflate" and body else body


@pytest.mark.parametrize("encoding", ["identity", "gzip, deflate"])
def test_every_frame_arrives_exactly(encoding: str) -> None:
    source = make_source(1)
    with running(source) as server:
        header = {"Accept-Encoding": encoding}
        page = Page(describe(source), lambda address: fetch(server, f"/{address}", **header)[1])
        for frame in range(8):
            part = source.parts[(0, 0, 0, 0, 1, 2, 2, 2)[frame]]
            assert_same_rows(page.frame(frame), part.frame(frame - part.first))
        answer, _ = fetch(server, "/frames/1.bin", **header)
        assert answer.getheader("Content-Encoding") == ("deflate" if "deflate" in encoding else None)


def test_scene_json_names_frames_and_cameras() -> None:
    with running(make_source()) as server:
        told = json.loads(fetch(server, "/scene.json")[1])
    assert [(s["first"], s["length"]) for s in told["segments"]] == [(0, 4), (4, 1), (5, 3)]
    assert [camera["held_out"] for camera in told["cameras"]] == [False, False, True, False]
    assert PinholeCamera.from_json(told["cameras"][1]).name == "cam1"
    assert np.cumsum([0, *told["steps_ns"]]).tolist() == [index * 1001 * 10**9 // 30000 for index in range(8)]


@pytest.mark.parametrize(
    "path",
    [
        "/frames/8.bin",
        "/segments/3/0.bin",
        "/segments/0/2.bin",
        "/segments/0.bin",
        "/frames/1/0.bin",
        "/frames/0.bin",
        "/tables.bin",
        "/frames/-1.bin",
        "/frames/01.bin",
        "/frames/99999999999.bin",
        "/frames/0",
        "/server.py",
        "/../server.py",
        "/%2e%2e/server.py",
        "//etc/passwd",
        "/page.html",
        "/nothing",
    ],
)
def test_bad_paths_are_not_found(path: str) -> None:
    with running(make_source()) as server:
        answer, body = fetch(server, path)
    assert (answer.status, body) == (404, b"nothing here\n")


def test_head_tells_the_size_and_sends_nothing() -> None:
    with running(make_source()) as server:
        whole = fetch(server, "/scene.json")[1]
        answer, body = fetch(server, "/scene.json", method="HEAD")
    assert (answer.status, int(answer.getheader("Content-Length", "0")), body) == (200, len(whole), b"")


def test_a_site_that_points_its_name_here_reads_nothing() -> None:
    with running(make_source()) as server:
        assert fetch(server, "/frames/1.bin", Host="attacker.example:80")[0].status == 403
        assert fetch(server, "/frames/1.bin", Host="localhost:1234")[0].status == 200


def test_damage_reaches_the_page_as_words() -> None:
    class Damaged(SegmentSource):
        def moving(self, frame: int) -> Codes:
            raise ValueError("packet 3 is damaged")

    with running(Damaged(make_source().parts, make_quantizer())) as server:
        answer, body = fetch(server, "/frames/1.bin")
    assert (answer.status, body) == (500, b"/frames/1.bin: packet 3 is damaged\n")


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    asked=st.binary(max_size=300)
    | st.sampled_from([b"GET ", b"HEAD ", b"POST ", b"get "]).flatmap(
        lambda start: st.binary(max_size=80).map(lambda rest: start + b"/frames/1.bin HTTP/1.1\r\nHost:" + rest)
    )
)
def test_whatever_is_sent_the_server_goes_on(
    asked: bytes, capfd: pytest.CaptureFixture[str], asked_server: ViewerServer
) -> None:
    with socket.create_connection(asked_server.server_address[:2], timeout=5) as caller:
        caller.sendall(asked + b"\r\n\r\n")
        caller.shutdown(socket.SHUT_WR)
        with contextlib.suppress(ConnectionError):
            while caller.recv(1 << 16):
                pass
    assert fetch(asked_server, "/frames/1.bin")[0].status == 200
    assert capfd.readouterr().err == ""  # no traceback on the terminal


@pytest.fixture(scope="module")
def asked_server() -> Iterator[ViewerServer]:
    with running(make_source()) as server:
        yield server


def test_callers_too_many_are_hung_up_on_and_others_are_served_again() -> None:
    with running(make_source()) as server, contextlib.ExitStack() as silent:
        for _ in range(MOST_CONNECTIONS):
            silent.enter_context(socket.create_connection(server.server_address[:2], timeout=5))
        one_more = silent.enter_context(socket.create_connection(server.server_address[:2], timeout=5))
        assert one_more.recv(1) == b""
        silent.close()
        wait_until = time.monotonic() + 5
        while True:
            with contextlib.suppress(ConnectionError):
                assert fetch(server, "/frames/1.bin")[0].status == 200
                break
            assert time.monotonic() < wait_until


def test_a_caller_who_says_nothing_is_hung_up_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("packuv.viewer.server._Handler.timeout", 0.2)
    with running(make_source()) as server, socket.create_connection(server.server_address[:2], timeout=5) as caller:
        assert caller.recv(1) == b""


# ---- page


def test_the_page_loads_nothing_from_elsewhere() -> None:
    with running(make_source()) as server:
        for path, (_, kind) in PAGES.items():
            answer, body = fetch(server, path)
            assert (answer.status, answer.getheader("Content-Type")) == (200, kind)
            assert not re.search(rb"(https?:)?//[a-z0-9-]+\.[a-z]", body, re.IGNORECASE)
            assert "default-src 'self'" in answer.getheader("Content-Security-Policy", "")


def test_every_script_that_is_named_is_served() -> None:
    named = set()
    for name, _ in PAGES.values():
        text = (PAGE_FOLDER / name).read_text()
        named |= set(re.findall(r'(?:src=|from |Worker\()"(?:\./)?([\w.]+)"', text))
    assert named == {path.lstrip("/") for path in PAGES} - {""}


def test_ids_that_the_script_asks_for_are_on_the_page() -> None:
    page = (PAGE_FOLDER / "page.html").read_text()
    present = set(re.findall(r'id="([\w-]+)"', page))
    script = (PAGE_FOLDER / "viewer.js").read_text()
    asked = set(re.findall(r'(?:at|press)\("([\w-]+)"', script))
    assert asked - present == set()


# ---- end to end


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with running_browser(tmp_path_factory.mktemp("profile")) as started:
        yield started


@pytest.mark.slow
@pytest.mark.parametrize("sh_degree", [0, 3])
def test_the_page_draws_what_the_rasterizer_draws(browser: Browser, sh_degree: int) -> None:
    source = replace(make_source(sh_degree), near=0.1)
    camera, background = source.cameras[2], (0.2, 0.4, 0.6)
    with running(source) as server:
        wish = f"bare=1&play=0&frame=6&camera={camera.name}&background={','.join(map(str, background))}"
        browser.open(f"{server.url}#{wish}", camera.width, camera.height)
        browser.wait_for("document.documentElement.dataset.frame == 6")
        shown = browser.picture().astype(np.float64) / 255
    gaussians = source.quantizer.decode(source.parts[2].frame(1))
    wanted = render(gaussians, camera, options=RasterOptions(near=0.1), background=background).colour
    error = shown - np.clip(wanted.transpose(1, 2, 0), 0, 1)
    # 8 bits alone allow 59 dB; half floats and depth ties inside 1/4096 take the rest. Measured: see docs/viewer.md.
    assert -10 * np.log10(np.mean(error**2)) > 52
    assert wanted.std() > 0.1  # there is something to compare


LIGHT = np.array([[0, 0, 0], [0.3, -0.2, 0], [0, 0, 0], [-0.9, 0, 0.4], [0.1, 0.1, 0.1], [0, 0, 0], [0.5, -0.4, 0.1]])


class Lit(SegmentSource):
    """Frames in light of their own."""

    @property
    def light(self) -> np.ndarray:
        return np.concatenate([LIGHT, np.zeros((1, 3))])


def test_the_page_is_told_light_where_it_is_not_steady() -> None:
    source = make_source()
    assert "light" not in describe(source)
    told = json.loads(json.dumps(describe(Lit(source.parts, source.quantizer))))
    assert np.array_equal(told["light"][:7], LIGHT)


def test_the_page_is_told_up_where_it_is_known() -> None:
    source = make_source()
    assert "up" not in describe(source)
    assert describe(replace(source, up=(0.0, 0.6, -0.8)))["up"] == [0.0, 0.6, -0.8]


@pytest.mark.slow
def test_the_page_shows_every_frame_in_its_light(browser: Browser) -> None:
    plain = make_source(1, count=6000)
    source = Lit(plain.parts, plain.quantizer, plain.rate, plain.cameras, near=0.1)
    camera, background = source.cameras[2], (0.2, 0.4, 0.6)
    with running(source) as server:
        wish = f"bare=1&play=0&frame=6&camera={camera.name}&background={','.join(map(str, background))}"
        browser.open(f"{server.url}#{wish}", camera.width, camera.height)
        for frame, key in ((6, ""), (7, "ArrowRight"), (6, "ArrowLeft"), (0, "Home"), (1, "ArrowRight")):
            if key:
                browser.evaluate(f"dispatchEvent(new KeyboardEvent('keydown', {{ key: '{key}' }}))")
            browser.wait_for(f"document.documentElement.dataset.frame == {frame}")
            shown = browser.picture().astype(np.float64).transpose(2, 0, 1) / 255
            part = source.parts[0 if frame < 4 else 2]
            drawn = render(source.quantizer.decode(part.frame(frame - part.first)), camera, options=NEAR)
            rest = 1 - drawn.alpha
            # The page's background is no part of the scene: light leaves it alone, and so what shines through.
            wanted = lit(drawn.colour, source.light[frame]) - rest * lit(np.zeros((3, 1, 1)), source.light[frame])
            wanted = np.clip(wanted + rest * np.array(background)[:, None, None], 0, 1)
            assert -10 * np.log10(np.mean((shown - wanted) ** 2)) > 50  # as in steady light
            covered = drawn.alpha > 0.99
            assert covered.sum() > 1000
            seen = np.clip(lit(drawn.colour, source.light[frame]), 0, 1)  # what `packuv render` writes
            assert -10 * np.log10(np.mean((shown - seen)[:, covered] ** 2)) > 45


@pytest.mark.slow
def test_playback_stands_still_where_the_buffer_ends(browser: Browser) -> None:
    class Stuck(SegmentSource):
        def moving(self, frame: int) -> Codes:
            if frame >= 6:
                raise OSError("frame 6 will never come")
            return super().moving(frame)

    whole = make_source()
    with running(Stuck(whole.parts, whole.quantizer, Fraction(20), whole.cameras)) as server:
        browser.open(f"{server.url}#camera=cam1", 480, 360)
        browser.wait_for("document.documentElement.dataset.frame == 5")
        time.sleep(1)  # 20 frames' time
        assert browser.evaluate("document.documentElement.dataset.frame") == "5"
        assert "will never come" in browser.evaluate("document.getElementById('wait').textContent")


@pytest.mark.slow
def test_what_is_damaged_is_skipped_and_counted(browser: Browser) -> None:
    """The keyframe of frames 4 to 4, and frame 6; all others are there at once and play."""

    class Damaged(SegmentSource):
        def key(self, segment: int) -> Codes:
            if segment == 1:
                raise ValueError("packet 1 is damaged")
            return super().key(segment)

        def moving(self, frame: int) -> Codes:
            if frame == 6:
                raise ValueError("packet 3 is damaged")
            return super().moving(frame)

    whole, element = make_source(), "document.documentElement.dataset"
    with running(Damaged(whole.parts, whole.quantizer, Fraction(20), whole.cameras)) as server:
        browser.open(f"{server.url}#camera=cam1", 480, 360)
        browser.wait_for(f"{element}.frame !== undefined")  # before that, the page before may hear it
        browser.evaluate("window.seen = new Set(); new MutationObserver(() => seen.add("
                         f"{element}.frame)).observe(document.documentElement, {{ attributes: true }})")  # fmt: skip
        browser.wait_for("seen.has('5') && seen.has('7') && seen.has('0')", seconds=8)
        assert browser.evaluate(f"{element}.lost") == "2"
        assert not browser.evaluate("seen.has('4') || seen.has('6')")
        assert browser.evaluate("document.getElementById('lost').textContent") == "2 of 8 frames skipped"
        assert browser.evaluate("document.getElementById('wait').hidden")


def press(browser: Browser, key: str) -> None:
    browser.evaluate(f"dispatchEvent(new KeyboardEvent('keydown', {{ key: '{key}' }}))")


def shown_at(browser: Browser, server: ViewerServer, wish: str, width: int, height: int, frame: int) -> np.ndarray:
    """The page's picture of a frame, float64 [H, W, 3] in [0, 1]."""
    browser.open(f"{server.url}#{wish}", width, height)
    browser.wait_for(f"document.documentElement.dataset.frame == {frame}")
    return browser.picture().astype(np.float64) / 255


@pytest.mark.slow
def test_bands_of_view_dependence_are_drawn_one_by_one(browser: Browser) -> None:
    source = replace(make_source(3), near=0.1)
    camera, gaussians = source.cameras[1], source.quantizer.decode(source.parts[0].frame(0))
    band = np.repeat([0, 1, 2, 3], [1, 3, 5, 7])  # of each coefficient
    with running(source) as server:
        for mask in (15, 1, 3, 7, 2, 4, 8):
            wish = f"bare=1&play=0&frame=0&camera={camera.name}&background=0,0,0&bands={mask}"
            shown = shown_at(browser, server, wish, camera.width, camera.height, 0)
            kept = ((mask >> band) & 1).astype(np.float32)
            drawn = render(replace(gaussians, sh=gaussians.sh * kept[:, None]), camera, options=NEAR)
            error = shown - np.clip(drawn.colour.transpose(1, 2, 0), 0, 1)
            assert -10 * np.log10(np.mean(error**2)) > 52, mask  # as with all bands


@pytest.mark.slow
def test_playback_turns_about_at_both_ends(browser: Browser) -> None:
    whole, element = make_source(), "document.documentElement.dataset"
    with running(replace(whole, rate=Fraction(6))) as server:  # slow enough to show every frame
        browser.open(f"{server.url}#camera=cam1&ends=bounce", 320, 240)
        browser.wait_for(f"{element}.frame !== undefined")
        browser.evaluate("window.seen = []; new MutationObserver(() => { if (seen.at(-1) !== +" + element +
                         ".frame) seen.push(+" + element + ".frame); })"
                         ".observe(document.documentElement, { attributes: true })")  # fmt: skip
        browser.wait_for("seen.join().match(/7,.*\\b0,.*\\b7/)")
        seen = browser.evaluate("seen")
        turns = np.flatnonzero(np.diff(np.sign(np.diff(seen)))) + 1
        assert {seen[turn] for turn in turns} == {0, 7}
        browser.evaluate("document.getElementById('ends').click()")
        assert browser.evaluate("document.getElementById('ends').textContent") == "Once"
        browser.wait_for(f"{element}.frame == 7 && document.getElementById('play').textContent == 'Play'")


@pytest.mark.slow
def test_a_link_gives_the_very_picture_again(browser: Browser) -> None:
    with running(replace(make_source(1), near=0.1)) as server:
        shown_at(browser, server, "bare=1&play=0&frame=2&camera=cam1", 320, 240, 2)
        drag = "for (const [name, x] of [['pointerdown', 90], ['pointermove', 150], ['pointerup', 150]])" \
               " document.getElementById('picture').dispatchEvent(new PointerEvent(name," \
               " { clientX: x, clientY: 80, pointerId: 1, buttons: 1 }))"  # fmt: skip
        browser.evaluate(f"Element.prototype.setPointerCapture = () => {{}}; {drag}")
        press(browser, "b")
        press(browser, "u")
        browser.wait_for("location.hash.includes('view=')")
        time.sleep(1)  # drawn
        before = browser.picture()
        again = browser.evaluate("location.hash")
        assert "bands=1" in again
        after = shown_at(browser, server, f"{again[1:]}&bare=1", 320, 240, 2)
        assert np.abs(after - before / 255).max() <= 2 / 255  # nine digits
        for bad in ("view=1,2,3", "view=" + ",".join(["0"] * 16), "view=x"):
            shown_at(browser, server, f"play=0&frame=2&camera=cam1&{bad}", 320, 240, 2)


@pytest.mark.slow
def test_a_span_is_measured_between_the_points_that_are_clicked(browser: Browser) -> None:
    source, camera = make_source(), make_ring(width=400, height=300)[0]
    points = np.array([[-0.6, 0.1, 0.2], [0.7, -0.3, 0.4]])
    scales, still_turned = np.full((2, 3), -2.5), np.array([[1.0, 0, 0, 0]] * 2)
    values = points, scales, still_turned, np.full(2, OPACITY_RANGE[1]), np.zeros((2, 1, 3))
    codes = source.quantizer.encode(Gaussians(*(value.astype(np.float32) for value in values)))
    still = np.empty((0, 0, 3), np.uint16), np.empty((0, 0, codes.attributes.shape[1]), np.uint8)
    part = Segment(0, codes, np.zeros(2, bool), *still)
    placed = source.quantizer.decode(codes).means
    seen = placed @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]
    pixels = seen[:, :2] / seen[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    with running(replace(source, parts=(part,), cameras=(camera,), near=0.1, metric=True)) as server:
        shown_at(browser, server, "play=0&frame=0", camera.width, camera.height, 0)
        press(browser, "m")
        for x, y in pixels:
            browser.evaluate("for (const name of ['pointerdown', 'click']) document.getElementById('picture')"
                             f".dispatchEvent(new PointerEvent(name, {{ clientX: {x}, clientY: {y} }}))")  # fmt: skip
        span = float(browser.evaluate("document.documentElement.dataset.span"))
        assert span == pytest.approx(np.linalg.norm(placed[0] - placed[1]), rel=0.01)  # to a pixel, in half floats
        assert browser.evaluate("document.querySelector('#ruler text').textContent").endswith(" m")
        press(browser, "Escape")
        assert browser.evaluate("document.getElementById('ruler').hasAttribute('hidden')")


@pytest.mark.slow
@pytest.mark.parametrize(("width", "height", "folded"), [(1280, 720, False), (844, 390, True), (390, 844, True)])
def test_panels_fold_on_small_screens_and_nothing_hangs_out(
    browser: Browser, width: int, height: int, folded: bool
) -> None:
    def inside(name: str) -> bool:
        box = browser.evaluate(f"document.getElementById('{name}').getBoundingClientRect().toJSON()")
        corners = box["left"] >= 0, box["top"] >= 0, box["right"] <= width, box["bottom"] <= height
        return bool(box["width"]) and all(corners)

    with running(make_source()) as server:
        shown_at(browser, server, "play=0&frame=0", width, height, 0)
        assert inside("bar")
        assert inside("about")
        assert inside("side") is not folded
        assert browser.evaluate("document.getElementById('track').clientWidth") > 250
        press(browser, "v")
        assert inside("side") is folded


@pytest.mark.slow
def test_a_message_that_is_closed_stays_closed_until_there_is_another(browser: Browser) -> None:
    class Stuck(SegmentSource):
        def moving(self, frame: int) -> Codes:
            if frame >= 2:
                raise OSError("frame 2 will never come")
            return super().moving(frame)

    whole = make_source()
    with running(Stuck(whole.parts, whole.quantizer, Fraction(20), whole.cameras)) as server:
        browser.open(f"{server.url}#camera=cam1", 480, 360)
        browser.wait_for("!document.getElementById('wait').hidden && !!document.querySelector('#wait.bad')")
        browser.evaluate("document.getElementById('dismiss').click()")
        assert browser.evaluate("document.getElementById('wait').hidden")
        time.sleep(2)  # tried again meanwhile
        assert browser.evaluate("document.querySelector('#wait.bad:not([hidden])') === null")


def test_the_page_is_told_the_worst_frame_and_how_long_decoding_took() -> None:
    with running(make_source()) as server:
        server.worst = 6
        assert json.loads(fetch(server, "/scene.json")[1])["worst"] == 6
        assert re.fullmatch(r"decode;dur=\d+\.\d", fetch(server, "/frames/1.bin")[0].getheader("Server-Timing") or "")
        server.worst = None
        assert "worst" not in json.loads(fetch(server, "/scene.json")[1])


def test_a_port_that_is_taken_is_named(scene_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ValueError, match=f"port {port} of 127.0.0.1 cannot be had: .*name another --port"):
            serve(scene_path, port=port)
    with pytest.raises(ValueError, match="--host must be an address of this machine"):
        serve(scene_path, host="198.51.100.7")


class Drawn:
    """Pictures of which the viewer's own should differ by rounding alone; of a camera and frame there is none."""

    cameras = ("cam0", "cam1", "ca/m ü")

    def __init__(self, source: SegmentSource) -> None:
        self._source = source

    def picture(self, camera: str, frame: int) -> np.ndarray | None:
        if camera != "cam1" or frame == 3:
            return None
        gaussians = self._source.quantizer.decode(self._source.parts[0].frame(frame))
        background = (0.2, 0.4, 0.6)
        drawn = render(gaussians, self._source.cameras[1], options=NEAR, background=background).colour
        pixels: np.ndarray = np.rint(255 * np.clip(drawn, 0, 1)).astype(np.uint8).transpose(1, 2, 0)
        return pixels


def test_what_was_filmed_is_served_exactly_and_only_where_there_is_something() -> None:
    source = make_source()
    with running(source) as server:
        assert "truth" not in json.loads(fetch(server, "/scene.json")[1])
        assert fetch(server, "/truth/cam1/0.png")[0].status == 404
        truth = Drawn(source)
        server.truth = truth
        assert json.loads(fetch(server, "/scene.json")[1])["truth"] == list(truth.cameras)
        answer, body = fetch(server, "/truth/cam1/2.png")
        assert (answer.status, answer.getheader("Content-Type")) == (200, "image/png")
        shown = cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
        assert np.array_equal(shown, truth.picture("cam1", 2))
        for path in ("cam1/3.png", "cam1/8.png", "cam9/0.png", "ca%2Fm%20%C3%BC/0.png", "cam1/00.png", "../x/0.png"):
            assert fetch(server, f"/truth/{path}")[0].status == 404


@pytest.mark.slow
def test_what_was_filmed_lies_beside_over_and_minus_the_render(browser: Browser) -> None:
    source = replace(make_source(), near=0.1)
    camera, element = source.cameras[1], "document.documentElement.dataset"

    def page(mode: str, width: int, height: int, frame: int = 2) -> np.ndarray:
        wish = f"bare=1&play=0&frame={frame}&camera=cam1&background=0.2,0.4,0.6&truth={mode}"
        shown_at(browser, server, wish, width, height, frame)
        browser.wait_for(f"{element}.truth !== undefined")
        time.sleep(0.5)  # drawn
        return browser.picture().astype(np.float64)

    with running(source) as server:
        server.truth = Drawn(source)
        filmed = server.truth.picture("cam1", 2)
        assert filmed is not None
        assert page("minus", camera.width, camera.height).mean() < 4 * 0.5  # four times brighter; rounding to 8 bits
        both = page("beside", 2 * camera.width, camera.height)
        left, right = both[:, : camera.width], both[:, camera.width :]
        assert np.abs(right - filmed).max() <= 1
        assert np.abs(left - filmed).mean() < 0.5
        assert np.abs(page("over", camera.width, camera.height) - filmed).mean() < 0.5
        page("over", camera.width, camera.height, frame=3)
        assert browser.evaluate(f"{element}.truth") == "truth/cam1/3.png is not there"
        assert browser.evaluate("document.getElementById('truth').hidden || !document.getElementById('truth').src")


@pytest.mark.slow
def test_the_page_writes_camera_paths_that_films_read(browser: Browser, tmp_path: Path) -> None:
    source, element = make_source(), "document.documentElement.dataset"
    with running(source) as server:
        shown_at(browser, server, "play=0&frame=2&camera=cam1", 320, 240, 2)
        press(browser, "k")
        press(browser, "]")
        press(browser, "End")
        browser.wait_for(f"{element}.frame == 7")
        browser.wait_for("document.querySelector('#cameras [aria-current=true]').dataset.camera == 'cam2'")
        time.sleep(1)  # it has flown there
        for key in ("k", "k", "Backspace", "j"):
            press(browser, key)
        (tmp_path / "path.json").write_text(browser.evaluate(f"{element}.path"))
    path = CameraPath.load(tmp_path / "path.json")
    assert [(view.seconds, view.frame) for view in path.views] == [(0, 2), (2, 7)]
    for view, camera in zip(path.views, source.cameras[1:3], strict=True):
        wanted = camera.to_json()
        for name in ("width", "height", "fx", "fy", "cx", "cy"):
            assert getattr(view.camera, name) == pytest.approx(wanted[name])
        assert np.allclose(view.camera.camera_from_world, camera.camera_from_world, atol=1e-9)


@pytest.mark.slow
def test_the_page_films_a_path_as_films_do(browser: Browser, tmp_path: Path) -> None:
    """Cameras and frames are those of `packuv film`; the pictures are the page's, coded with loss."""
    source = replace(make_source(count=2000), near=0.1)
    with running(source) as server:
        shown_at(browser, server, "play=0&frame=0&camera=cam0&background=0,0,0", 320, 240, 0)
        press(browser, "k")
        press(browser, "]")
        press(browser, "End")
        browser.wait_for("document.documentElement.dataset.frame == 7")
        browser.wait_for("document.querySelector('#cameras [aria-current=true]').dataset.camera == 'cam1'")
        time.sleep(1)  # it has flown there
        for key in ("k", "j", "g"):
            press(browser, key)
        (tmp_path / "path.json").write_text(browser.evaluate("document.documentElement.dataset.path"))
        browser.wait_for("globalThis.filmed !== undefined")
        browser.evaluate("filmed.arrayBuffer().then((bytes) => { window.bytes = [...new Uint8Array(bytes)]; })")
        browser.wait_for("window.bytes !== undefined")
        (tmp_path / "film.mp4").write_bytes(bytes(browser.evaluate("bytes")))
    path = CameraPath.load(tmp_path / "path.json")
    with av.open(str(tmp_path / "film.mp4")) as film:
        stream = film.streams.video[0]
        assert (stream.width, stream.height, stream.average_rate) == (160, 120, source.rate)
        pictures = [frame.to_ndarray(format="rgb24") for frame in film.decode(stream)]
    assert len(pictures) == int(path.seconds * source.rate) + 1
    for number in (0, 20, 41, len(pictures) - 1):
        frame, camera = path.at(float(number / source.rate))
        part = source.parts[0 if frame < 4 else 1 if frame == 4 else 2]
        drawn = render(source.quantizer.decode(part.frame(frame - part.first)), camera, options=NEAR).colour
        error = pictures[number] / 255 - np.clip(drawn.transpose(1, 2, 0), 0, 1)
        assert -10 * np.log10(np.mean(error**2)) > 20, number  # of noise, by H.264 with chroma at half size


def test_layers_are_those_of_the_atlas() -> None:
    source = make_source(count=3000)
    with running(source) as server:
        assert json.loads(fetch(server, "/scene.json")[1])["layers"] == UvOptions().layers
        for number, part in enumerate(source.parts):
            layers = np.frombuffer(fetch(server, f"/layers/{number}.bin")[1], np.uint8)
            key = server.bodies.codes(part.first)
            assert_same_rows(key, part.key)
            opacity = key.attributes[:, OPACITY]
            shown = opacity > 0
            points = source.quantizer.decode(key[shown]).means
            slots = assign_slots(points, opacity[shown], source.quantizer.centre, options=UvOptions())
            assert np.array_equal(layers[shown], slots.layer + 1)
            assert not layers[~shown].any()
        assert fetch(server, "/layers/3.bin")[0].status == 404


@pytest.mark.slow
def test_the_page_colours_by_layer(browser: Browser) -> None:
    """One opaque Gaussian behind the other, seen from the centre: the first layer takes the more opaque one."""
    source, camera = make_source(), make_ring()[0]
    first = np.array([0.4, 0.1, 0.6])
    centre = source.quantizer.centre
    points = np.array([centre + first, centre + 0.8 * first + [0, 0, 1e-5]])
    still, opacity = np.array([[1.0, 0, 0, 0]] * 2), np.array([OPACITY_RANGE[1], 1.0])
    values = points, np.full((2, 3), -1.6), still, opacity, np.zeros((2, 1, 3))
    codes = source.quantizer.encode(Gaussians(*(value.astype(np.float32) for value in values)))
    part = Segment(0, codes, np.zeros(2, bool), np.empty((0, 0, 3), np.uint16), np.empty((0, 0, 10), np.uint8))
    taken = np.frombuffer(zlib.decompress(Bodies(replace(source, parts=(part,))).layers(0)), np.uint8)
    with running(replace(source, parts=(part,), cameras=(camera,), near=0.1)) as server:
        shown_at(browser, server, "play=0&frame=0&bare=1&mode=layer&background=0,0,0", camera.width, camera.height, 0)
        browser.wait_for("document.documentElement.dataset.layers == 0")
        time.sleep(0.5)
        shown = browser.picture().astype(int)
    far = np.argmax(codes.attributes[:, OPACITY])
    pixel, _ = camera.project(source.quantizer.decode(codes).means[[far]])
    x, y = pixel[0].astype(int)
    assert sorted(taken) == [1, 2] or sorted(taken) == [1, 1]
    assert shown[y, x].min() > 60  # light, for the first layer is there
    assert shown[y, x, 0] > 0.8 * shown[y, x, 2]  # and not purple or blue
