import json
import subprocess
from fractions import Fraction

import av
import numpy as np
import pytest

from packuv.scene.matroska import Decoder, Encoder, Packet, Reader, Spool, VideoTrack, write_matroska
from tests.support.needs import needs_ffmpeg

TRACKS = (VideoTrack("large", 256, 128, 16), VideoTrack("small", 96, 64, 6))
TIMES = {0: [0, 99, 1000], 1: [33, 66, 132, 700, 1033, 5000]}
ATTACHMENTS = {
    "a.json": ("application/json", b'{"a": 1}'),
    "b.bin": ("application/octet-stream", bytes(range(256)) * 9),
}


def pictures():
    """Smooth, noisy and constant pictures by (track, time)."""
    rng, result = np.random.default_rng(0), {}
    for track, times in TIMES.items():
        height, width = TRACKS[track].height, TRACKS[track].width
        for k, time in enumerate(times):
            noise = rng.integers(0, (1, 7, 256)[k % 3], (height, width))
            result[track, time] = ((np.arange(width) + noise) % 256).astype(np.uint8)
    return result


def write(path, *, encoders=1):
    """With so many encoders a track, which take turns."""
    pools = [[Encoder(track) for _ in range(encoders)] for track in TRACKS]
    content = sorted(pictures().items(), key=lambda item: item[0][1])
    packets = [
        Packet(track, time, 33, pools[track][k % encoders].encode(picture))
        for k, ((track, time), picture) in enumerate(content)
    ]
    write_matroska(path, TRACKS, packets, ATTACHMENTS, rate=Fraction(30))
    return {(packet.track, packet.time_ms): packet.data for packet in packets}


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("matroska") / "file.mkv"
    return path, write(path)


def test_pictures_come_back_in_any_order(file):
    path, packets = file
    reader, wanted = Reader(path), pictures()
    decoders = [Decoder(track, private) for track, private in zip(TRACKS, reader.codec_private, strict=True)]
    order = list(wanted)
    for pass_order in (order, order[::-1], [order[k] for k in np.random.default_rng(0).integers(0, len(order), 30)]):
        for track, time in pass_order:
            found = reader.read(track, time)
            assert found.data == packets[track, time]
            start, stop = found.span(path)
            assert path.read_bytes()[start:stop] == found.data
            assert np.array_equal(decoders[track].decode(found.data), wanted[track, time])
    reader.close()


def test_tracks_and_attachments_come_back(file):
    reader = Reader(file[0])
    assert reader.tracks == ("large", "small")
    assert reader.attachments == {name: content for name, (_, content) in ATTACHMENTS.items()}
    reader.close()


def test_same_input_same_bytes_whatever_the_encoders(file, tmp_path):
    write(tmp_path / "again.mkv", encoders=3)
    assert (tmp_path / "again.mkv").read_bytes() == file[0].read_bytes()


@needs_ffmpeg
@pytest.mark.parametrize("track", [0, 1])
def test_ffmpeg_decodes_the_same_pictures(file, track):
    command = ["ffmpeg", "-v", "error", "-i", file[0], "-map", f"0:v:{track}", "-fps_mode", "passthrough"]
    raw = subprocess.run([*command, "-f", "rawvideo", "-"], check=True, capture_output=True).stdout
    assert raw == b"".join(pictures()[track, time].tobytes() for time in TIMES[track])


@needs_ffmpeg
def test_ffprobe_sees_times_titles_and_codecs(file):
    command = ["ffprobe", "-v", "error", "-show_streams", "-show_packets", "-of", "json", file[0]]
    seen = json.loads(subprocess.run(command, check=True, capture_output=True).stdout)
    video = [stream for stream in seen["streams"] if stream["codec_type"] == "video"]
    assert [(s["codec_name"], s["pix_fmt"], s["tags"]["title"]) for s in video] == [
        ("ffv1", "gray", "large"),
        ("ffv1", "gray", "small"),
    ]
    for track, times in TIMES.items():
        assert [round(1000 * float(p["pts_time"])) for p in seen["packets"] if p["stream_index"] == track] == times


def test_a_missing_packet_is_named(file):
    reader = Reader(file[0])
    for time in (1, 67, 10**7):
        with pytest.raises(ValueError, match=f"track 'small' has no packet at {time} ms"):
            reader.read(1, time)
    assert reader.read(1, 66).data == file[1][1, 66]  # the reader still works
    reader.close()


def test_a_packet_that_is_none_is_refused(file):
    reader, packet = Reader(file[0]), bytearray(file[1][0, 99])
    packet[:8] = bytes(8)
    with pytest.raises(ValueError, match="'large' does not decode"):
        Decoder(TRACKS[0], reader.codec_private[0]).decode(bytes(packet[:5]))
    with pytest.raises(ValueError, match="'large' does not decode"):
        Decoder(TRACKS[0], b"no parameters").decode(file[1][0, 99])
    reader.close()


def test_what_is_no_matroska_file_is_refused(tmp_path, file):
    with pytest.raises(FileNotFoundError):
        Reader(tmp_path / "missing.mkv")
    (tmp_path / "text.mkv").write_text("hello")
    with pytest.raises(ValueError, match="not a Matroska file"):
        Reader(tmp_path / "text.mkv")
    (tmp_path / "head.mkv").write_bytes(file[0].read_bytes()[:60])
    with pytest.raises(ValueError, match="damaged or cut short"):
        Reader(tmp_path / "head.mkv")


def test_a_film_is_no_scene(tmp_path):
    path = tmp_path / "film.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=25, width=64, height=64, pix_fmt="yuv420p")
        container.mux(stream.encode(av.VideoFrame.from_ndarray(np.zeros((64, 64, 3), np.uint8), format="rgb24")))
        container.mux(stream.encode())
    with pytest.raises(ValueError, match=r"film\.mkv: video track 0 must be FFV1"):
        Reader(path)


def test_a_picture_of_another_shape_is_refused():
    encoder = Encoder(TRACKS[1])
    with pytest.raises(ValueError, match=r"uint8 \(64, 96\) pictures, but got uint8 \(96, 64\)"):
        encoder.encode(np.zeros((96, 64), np.uint8))
    with pytest.raises(ValueError, match="float64"):
        encoder.encode(np.zeros((64, 96)))


def test_a_spool_gives_back_its_packets(tmp_path):
    rng = np.random.default_rng(0)
    packets = [Packet(k % 2, 10 * k, 10, rng.bytes(int(rng.integers(0, 5000)))) for k in range(20)]
    with (tmp_path / "spool").open("w+b") as file:
        spool = Spool(file)
        for packet in packets[:10]:
            spool.append(packet)
        assert list(spool) == packets[:10]
        for packet in packets[10:]:
            spool.append(packet)
        assert list(spool) == packets
