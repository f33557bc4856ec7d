"""Workers that train together: what one of them says, the first one raises."""

import os
import signal

import pytest

from dsar.errors import CaptureError, TrainingError
from dsar.training import workers


def work(kind, report):
    workers.barrier()
    if workers.rank() == 1:
        if kind == "capture":
            raise CaptureError("image 0007.png is broken")
        if kind == "system":
            open("/nowhere/0007.png")
        if kind == "killed":
            os.kill(os.getpid(), signal.SIGKILL)
    elif kind == "first":
        raise CaptureError("image 0008.png is broken")
    workers.barrier()


@pytest.mark.parametrize(
    ("kind", "error", "words"),
    [
        ("capture", CaptureError, r"image 0007\.png is broken"),
        ("first", CaptureError, r"image 0008\.png is broken"),
        ("system", FileNotFoundError, r"/nowhere/0007\.png"),
        ("killed", TrainingError, "worker 1 of 2 ended with signal 9, .* give fewer --workers"),
    ],
)
def test_the_reason_of_any_worker_is_raised_and_nothing_else_is_said(kind, error, words, capfd):
    with pytest.raises(error, match=words):
        workers.run_workers(2, work, (kind,), None)
    assert "Traceback" not in capfd.readouterr().err
