"""No encoder changes how the process is scheduled."""

import os
from fractions import Fraction

import av
import numpy as np
import pytest

from packuv.threads import ordinary_schedule


@pytest.mark.parametrize("name", ["libsvtav1", "libvpx-vp9", "ffv1"])
def test_all_threads_of_an_encoder_are_scheduled_as_ours(name):
    context = av.CodecContext.create(name, "w")
    context.width, context.height, context.pix_fmt, context.time_base = 64, 64, "yuv420p", Fraction(1, 30)
    with ordinary_schedule():
        context.open(strict=False)
    frame = av.VideoFrame.from_ndarray(np.zeros((96, 64), np.uint8), format="yuv420p")
    frame.pts = 0
    context.encode(frame)
    policies = {os.sched_getscheduler(int(thread)) for thread in os.listdir("/proc/self/task")}
    assert policies == {os.SCHED_OTHER}
    context.encode(None)
