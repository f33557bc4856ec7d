"""What the log says of the guards of a rollout: one line for each kind of finding, not for each frame."""

import logging
from collections.abc import Mapping

from dsar.avatar.guards import Guard
from dsar.avatar.watchdog import REPLACING
from dsar.types import GuardedFrame

LOGGER = logging.getLogger(__name__)


def log_guarded(motion: str, guarded: Mapping[int, GuardedFrame], frames: int) -> None:
    """Warn of the frames of a motion that are far from training, and of those that were replaced.

    Args:
        motion: Its name.
        guarded: By frame number what guards found.
        frames: How many frames there are in all.
    """
    far = {
        number: found.exceeded[Guard.FAR] for number, found in guarded.items() if Guard.FAR in found.exceeded
    }
    if far:
        worst = max(far, key=lambda number: far[number])
        LOGGER.warning(
            "Motion %s: %d of %d frames, from %d to %d, are far from what the avatar was trained on, at "
            "worst %.2g times as far as any of it (frame %d): look at them",
            *(motion, len(far), frames, min(far), max(far), far[worst], worst),
        )
    replaced = {number: found.exceeded.keys() & REPLACING for number, found in guarded.items()}
    replaced = {number: names for number, names in replaced.items() if names}
    if replaced:
        LOGGER.warning(
            "Motion %s: %d of %d frames, from %d to %d, would have broken (%s) and follow from the pose "
            "alone; --no-guards shows what the network says",
            *(motion, len(replaced), frames, min(replaced), max(replaced)),
            ", ".join(sorted(set().union(*replaced.values()))),
        )
