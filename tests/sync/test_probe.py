"""Videos made here, whole and broken, against what PyAV decodes."""

import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from sync.probe import ColourTags, container_timecodes, probe_video
from sync.timecode import frames_to_ns
from tests.support.planes import shapes, write_planes

RATE = Fraction(30)


def make_video(
    path: Path,
    frames: int = 40,
    *,
    codec: str = "libx264",
    b_frames: int = 2,
    times: list[int] | None = None,
    rate: Fraction = RATE,
    muxer: dict[str, str] | None = None,
    metadata: dict[str, str] | None = None,
) -> Path:
    """Moving noise, 96 x 64; `times` in frame periods makes the rate vary."""
    rng = np.random.default_rng(0)
    with av.open(str(path), "w", options=muxer or {}) as out:
        options = {"g": "10", "bf": str(b_frames)} if codec == "libx264" else {}
        stream = out.add_stream(codec, rate=rate, options=options)
        assert isinstance(stream, av.VideoStream)
        stream.width, stream.height = 96, 64
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        for name, value in (metadata or {}).items():
            stream.metadata[name] = value
        for number in range(frames):
            picture = np.roll(rng.integers(0, 255, (64, 96, 3), dtype=np.uint8) // 8 + 100, number, axis=1)
            frame = av.VideoFrame.from_ndarray(picture, "rgb24")
            frame.time_base = 1 / rate
            frame.pts = times[number] if times else number
            out.mux(stream.encode(frame))
        out.mux(stream.encode())
    return path


def remux(source: Path, target: Path, *, shift_s: Fraction = Fraction(0)) -> Path:
    with av.open(str(source)) as inside, av.open(str(target), "w") as out:
        origin = inside.streams.video[0]
        stream = out.add_stream_from_template(origin)
        for packet in inside.demux(origin):
            if packet.dts is not None and packet.pts is not None:
                packet.stream = stream
                ticks = int(shift_s / packet.time_base)
                packet.pts, packet.dts = packet.pts + ticks, packet.dts + ticks
                out.mux(packet)
    return target


def decoded_times(path: Path) -> list[float]:
    with av.open(str(path)) as container:
        return [frame.time for frame in container.decode(video=0)]


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_video(tmp_path_factory.mktemp("video") / "cam.mp4")


@pytest.mark.parametrize("suffix", ["mp4", "mov", "mkv", "flv"])
@pytest.mark.parametrize("b_frames", [0, 2])
def test_counts_and_times_are_those_of_the_decoder(tmp_path: Path, suffix: str, b_frames: int) -> None:
    path = make_video(tmp_path / f"cam.{suffix}", b_frames=b_frames)
    info = probe_video(path)
    assert (info.width, info.height, info.codec, info.rate) == (96, 64, "h264", RATE)
    assert info.frame_count == 40
    assert np.allclose(info.pts_ns / 1e9, decoded_times(path), rtol=0, atol=1e-8)
    assert abs(info.duration_ns - 40 / 30 * 1e9) < 2e6  # Matroska and FLV count in milliseconds
    assert info.size_bytes == path.stat().st_size


@pytest.mark.parametrize(
    ("codec", "suffix"), [("mjpeg", "avi"), ("mpeg4", "avi"), ("mjpeg", "mov"), ("libvpx", "webm")]
)
def test_other_codecs(tmp_path: Path, codec: str, suffix: str) -> None:
    info = probe_video(make_video(tmp_path / f"cam.{suffix}", codec=codec))
    assert info.frame_count == 40
    assert info.rate == RATE


def test_colour_is_told_as_the_stream_says(tmp_path: Path) -> None:
    planes = [np.full(shape, 512, np.uint16) for shape in shapes("422", 48, 64)]
    path = write_planes(tmp_path / "a.mkv", "yuv422p10le", [planes], (9, 1, 18, 9))
    assert probe_video(path).colour == ColourTags("yuv422p10le", 10, "bt2020nc", "arib-std-b67", "bt2020", "limited")
    path = write_planes(tmp_path / "b.mkv", "yuv422p10le", [planes])
    assert probe_video(path).colour == ColourTags("yuv422p10le", 10, None, None, None, None)


def test_times_are_exact_at_ntsc_rates(tmp_path: Path) -> None:
    rate = Fraction(30000, 1001)
    info = probe_video(make_video(tmp_path / "cam.mp4", 100, rate=rate))
    assert info.rate == rate
    assert np.array_equal(info.pts_ns, frames_to_ns(np.arange(100), rate))


def test_a_variable_rate_keeps_its_times(tmp_path: Path) -> None:
    times = [0, 1, 2, 4, 5, 9, 10, 11, 12, 13]
    info = probe_video(make_video(tmp_path / "cam.mp4", 10, times=times))
    assert np.array_equal(info.pts_ns, frames_to_ns(np.array(times), RATE))
    assert info.rate == RATE


def test_fragmented_mp4(tmp_path: Path) -> None:
    flags = {"movflags": "frag_keyframe+empty_moov"}
    assert probe_video(make_video(tmp_path / "cam.mp4", muxer=flags)).frame_count == 40


def test_a_late_start_is_kept(video: Path, tmp_path: Path) -> None:
    info = probe_video(remux(video, tmp_path / "late.mkv", shift_s=Fraction(5, 2)))
    assert info.pts_ns[0] == 2_500_000_000
    assert container_timecodes(info).times_ns[0] == 2_500_000_000


def test_container_times_are_timecodes(video: Path) -> None:
    codes = container_timecodes(probe_video(video))
    assert codes.indices.tolist() == list(range(40))
    assert np.array_equal(codes.times_ns, frames_to_ns(np.arange(40), RATE))


def test_a_start_label_sets_the_times(tmp_path: Path) -> None:
    path = make_video(tmp_path / "cam.mov", codec="mjpeg", metadata={"timecode": "01:02:03:15"})
    info = probe_video(path)
    assert info.start_label == "01:02:03:15"
    assert container_timecodes(info).times_ns[1] == (3723 * 30 + 16) * 10**9 // 30


# Files that no frame can be taken from exactly


@pytest.mark.parametrize(
    ("name", "content"),
    [("text.mp4", b"hello, no video here"), ("noise.mp4", bytes(range(256)) * 40), ("zeros.mkv", bytes(5000))],
)
def test_what_is_no_video(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=f"{name} is no video"):
        probe_video(tmp_path / name)


def test_missing_and_empty_files(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"none\.mp4"):
        probe_video(tmp_path / "none.mp4")
    with pytest.raises(FileNotFoundError):
        probe_video(tmp_path)
    (tmp_path / "empty.mp4").touch()
    with pytest.raises(ValueError, match="is empty"):
        probe_video(tmp_path / "empty.mp4")


def test_pictures_and_sound_are_no_video(tmp_path: Path) -> None:
    with av.open(str(tmp_path / "sound.wav"), "w") as out:
        stream = out.add_stream("pcm_s16le", rate=8000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 8000), np.int16), layout="mono")
        frame.sample_rate = 8000
        out.mux(stream.encode(frame))
    make_video(tmp_path / "one.jpg", 1, codec="mjpeg")
    for name in ("sound.wav", "one.jpg"):
        with pytest.raises(ValueError, match="holds no video"):
            probe_video(tmp_path / name)


@pytest.mark.parametrize("share", [0.3, 0.6])
@pytest.mark.parametrize(
    ("suffix", "muxer"),
    [("mp4", {}), ("mp4", {"movflags": "faststart"}), ("mkv", {}), ("flv", {}), ("avi", {})],
)
def test_a_file_cut_short(tmp_path: Path, suffix: str, muxer: dict, share: float) -> None:
    whole = make_video(tmp_path / f"cam.{suffix}", 90, muxer=muxer, codec="mpeg4" if suffix == "avi" else "libx264")
    assert probe_video(whole).frame_count == 90
    data = whole.read_bytes()
    whole.write_bytes(data[: int(len(data) * share)])
    with pytest.raises(ValueError, match=r"cut short|its index is lost"):
        probe_video(whole)


def test_a_file_cut_between_two_frames(tmp_path: Path) -> None:
    """The header of an MP4 counts its frames, so a cut that damages none of the others is noticed, too."""
    path = make_video(tmp_path / "cam.mp4", 90, muxer={"movflags": "faststart"})
    with av.open(str(path)) as container:
        ends = sorted((packet.pos or 0) + packet.size for packet in container.demux(video=0) if packet.size)
    path.write_bytes(path.read_bytes()[: ends[-6]])
    with pytest.raises(ValueError, match="cut short"):
        probe_video(path)


def test_a_transport_stream_is_remuxed_by_the_command_given(video: Path, tmp_path: Path) -> None:
    stream = remux(video, tmp_path / "cam.ts", shift_s=Fraction(1))
    with pytest.raises(ValueError, match=r"remux it: ffmpeg -i cam\.ts -map 0:v:0 -c copy cam\.mp4"):
        probe_video(stream)
    assert probe_video(remux(stream, tmp_path / "again.mp4", shift_s=Fraction(-1))).frame_count == 40


@pytest.mark.parametrize("suffix", ["h264", "mpg"])
def test_bare_streams_are_to_be_encoded_again(video: Path, tmp_path: Path, suffix: str) -> None:
    if suffix == "mpg":
        path = make_video(tmp_path / "cam.mpg", codec="mpeg2video")
    else:
        path = make_video(tmp_path / "cam.h264")
    with pytest.raises(ValueError, match=rf"is a stream .*re-encode it: ffmpeg .*-i cam\.{suffix} "):
        probe_video(path)


def test_a_cut_without_encoding_is_refused(video: Path, tmp_path: Path) -> None:
    cut = remux(video, tmp_path / "cut.mp4", shift_s=Fraction(-1, 5))
    assert len(decoded_times(cut)) < 40  # the frames before 0 are hidden, not gone
    with pytest.raises(ValueError, match="edit list hides 6 of its 40 frames"):
        probe_video(cut)


def test_avi_with_b_frames_is_refused(tmp_path: Path) -> None:
    path = make_video(tmp_path / "cam.avi", b_frames=2)
    with pytest.raises(ValueError, match="AVI with B-frames"):
        probe_video(path)
    assert probe_video(make_video(tmp_path / "plain.avi", b_frames=0)).frame_count == 40


def write_large(path: Path, frames: int) -> Path:
    """One picture of noise, 3 MB of FFV1, again and again."""
    rng = np.random.default_rng(0)
    context = av.CodecContext.create("ffv1", "w")
    assert isinstance(context, av.VideoCodecContext)
    context.width, context.height, context.pix_fmt, context.time_base = 1280, 720, "bgr0", Fraction(1, 30)
    noise = av.VideoFrame.from_ndarray(rng.integers(0, 256, (720, 1280, 4), dtype=np.uint8), format="bgra")
    (coded,) = context.encode(noise.reformat(format="bgr0"))
    with av.open(str(path), "w", format="matroska") as out:
        stream = out.add_stream("ffv1", rate=30)
        stream.width, stream.height, stream.pix_fmt = 1280, 720, "bgr0"
        for number in range(frames):
            packet = av.Packet(bytes(coded))
            packet.stream, packet.time_base, packet.is_keyframe = stream, Fraction(1, 30), True
            packet.pts = packet.dts = number
            packet.duration = 1
            out.mux(packet)
    return path


PEAK = """
import sys
from pathlib import Path
from packuv.footage.reader import Packets
from sync.probe import probe_video
def peak(): return int(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0]) * 1024
before = peak()
print(probe_video(Path(sys.argv[1])).frame_count, len(Packets.read(Path(sys.argv[1])).ticks), peak() - before)
"""
ROOM_BYTES = 40_000_000
"""Measured: 6 MB for a video of 415 MB"""


def test_memory_does_not_depend_on_the_size_of_the_file(tmp_path):
    path = write_large(tmp_path / "large.mkv", 50)
    assert path.stat().st_size > 3 * ROOM_BYTES
    told = subprocess.run([sys.executable, "-c", PEAK, str(path)], check=True, capture_output=True, text=True)
    probed, demuxed, taken = map(int, told.stdout.split())
    assert probed == demuxed == 50
    assert taken < ROOM_BYTES
