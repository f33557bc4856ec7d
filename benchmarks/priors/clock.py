"""The processor's time, which other processes on the machine lengthen less than they do the clock's."""

import time
from collections.abc import Callable

RUNS = 3


def processor_ms(function: Callable[[], object], frames: int) -> float:
    """Return the shortest of several runs of this process, milliseconds a frame."""
    seconds = []
    for _ in range(RUNS):
        start = time.process_time()
        function()
        seconds.append(time.process_time() - start)
    return 1e3 * min(seconds) / frames
