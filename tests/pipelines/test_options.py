"""Settings of a run: who wins over whom, and what is refused."""

from __future__ import annotations

import re

import pytest

from packuv.footage import Transfer
from packuv.scene import TOLERANCES, Quality, Tolerance
from pipelines.options import SequenceOptions, check_raft, compose
from pipelines.request import PRESETS, RunRequest
from sync.capture import CaptureSettings
from sync.clock import ClockMode
from tasks.artefacts.recipe import OptionError, canonical, plain, restore

CAPTURE = CaptureSettings(reference="cam03", clock=ClockMode.TRIGGERED)


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_make_whole_options_that_survive_json(preset):
    options = compose(preset, CaptureSettings(), {})
    assert restore(SequenceOptions, plain(options)) == options


def test_presets_differ_and_go_up():
    fits = [compose(preset, CaptureSettings(), {}).fit for preset in PRESETS]
    for efforts in ([fit.frame_iterations for fit in fits], [fit.density.cap for fit in fits]):
        assert efforts == sorted(set(efforts))
    iterations = [fit.iterations for fit in fits]
    assert iterations == sorted(iterations)  # beyond those of standard they cost unseen cameras: docs/pareto.md
    assert len({canonical(compose(preset, CaptureSettings(), {})) for preset in PRESETS}) == len(PRESETS)


def test_the_user_wins_over_the_capture_and_that_over_the_preset():
    options = compose("draft", CAPTURE, {}, seed=7)
    assert (options.sync.reference, options.sync.clock, options.fit.seed) == ("cam03", ClockMode.TRIGGERED, 7)
    options = compose("draft", CAPTURE, {"sync": {"reference": "cam01"}, "fit": {"iterations": "12"}})
    assert (options.sync.reference, options.sync.clock, options.fit.iterations) == ("cam01", ClockMode.TRIGGERED, 12)
    log = CaptureSettings(transfer="slog3")
    assert compose("draft", log, {}).pictures.transfer is Transfer.SLOG3
    assert compose("draft", log, {"pictures": {"transfer": "none"}}).pictures.transfer is None
    assert options.fit.key_iterations == compose("draft", CAPTURE, {}).fit.key_iterations


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"fitt": {"iterations": 1}},
            r"unknown option fitt; valid here: pictures, sync, rig, scale, light, points",
        ),
        ({"fit": {"iteration": 1}}, r"unknown option fit\.iteration; valid here: photometric, .*, iterations, "),
        ({"fit": {"density": {"caps": 1}}}, r"unknown option fit\.density\.caps; valid here: "),
        ({"fit": {"iterations": "many"}}, r"fit\.iterations must be a whole number, but is 'many'"),
        ({"fit": 3}, r"fit must be a table of photometric, .*, but is 3"),
        ({"motion": {"evidence": "guess"}}, r"motion\.evidence must be one of change, flow, but is 'guess'"),
        ({"pictures": {"max_width": "3"}}, r"pictures: max_width must be at least 16 pixels, but is 3"),
    ],
)
def test_wrong_settings_are_named_by_their_path(settings, message):
    with pytest.raises(OptionError) as caught:
        compose("draft", CaptureSettings(), settings)
    assert re.match(message, str(caught.value)), str(caught.value)


def test_a_request_refuses_what_does_not_exist():
    with pytest.raises(ValueError, match="preset must be one of draft, standard, high, but is 'best'"):
        RunRequest("capture", "out", preset="best")


def test_quality_sets_the_tolerance_of_the_scene_file_and_settings_win_over_it():
    assert compose("draft", CAPTURE, {}).encode.tolerance.exact
    assert compose("draft", CAPTURE, {}, quality="high").encode.tolerance == TOLERANCES[Quality.HIGH]
    set_by_hand = {"encode": {"tolerance": {"position": 3}}}
    assert compose("draft", CAPTURE, set_by_hand, quality="low").encode.tolerance == Tolerance(3, 4)
    with pytest.raises(ValueError, match="memory_gb must be 0 or more, 10\\^9 bytes, but is -1"):
        RunRequest("/capture", "/out", memory_gb=-1)
    with pytest.raises(ValueError, match="quality must be one of lossless, high, medium, low, but is 'ultra'"):
        RunRequest("capture", "out", quality="ultra")


def test_raft_is_refused_before_any_work_where_its_weights_are_not_there(tmp_path):
    def check(**settings):
        check_raft(compose("draft", CaptureSettings(), settings))

    check()
    with pytest.raises(ValueError, match=r"motion\.backend is raft, but raft\.weights names no file; give"):
        check(motion={"backend": "raft"})
    with pytest.raises(FileNotFoundError, match=r"raft\.weights: there is no file .*none\.pth"):
        check(motion={"backend": "raft"}, raft={"weights": str(tmp_path / "none.pth")})
    (tmp_path / "text.pth").write_text("no weights")
    with pytest.raises(ValueError, match=r"text\.pth must be a state dict of torchvision's raft_large or raft_small"):
        check(motion={"backend": "raft"}, raft={"weights": str(tmp_path / "text.pth")})
    with pytest.raises(ValueError, match=r"but motion\.backend is dis; set motion\.backend=raft, too"):
        check(raft={"weights": "some.pth"})
    with pytest.raises(OptionError, match="at least one update"):
        check(raft={"updates": "0"})
