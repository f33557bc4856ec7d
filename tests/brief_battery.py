"""The whole battery over motions of some tenths of a second, for tests that ask for no more."""

from functools import partial

import pytest

from dsar.evaluation import stress as battery
from dsar.evaluation.looping import loop_motion
from dsar.evaluation.stress import memory, poses, prior, strain
from dsar.evaluation.stress.motions import Key, spin_and_stop, sway_motion, wander_poses

CASES = {
    **battery.CASES,
    "long": partial(battery.run_long, frames=1),
    "cycle": partial(battery.run_cycle, cycles=6),
    "twin": partial(battery.run_twin, start=3),
}
"""The battery, over no more frames than each case needs."""


def shorten_motions(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the cases make short motions."""
    brief_spin = partial(spin_and_stop, spin=0.5, rest=3.2)
    monkeypatch.setattr(memory, "loop_motion", partial(loop_motion, bridge=0.2))
    monkeypatch.setattr(memory, "sway_motion", partial(sway_motion, seconds=0.2))
    monkeypatch.setattr(memory, "spin_and_stop", brief_spin)
    monkeypatch.setattr(prior, "spin_and_stop", partial(spin_and_stop, spin=0.5))
    monkeypatch.setattr(prior, "REST_SECONDS", 3.2)
    monkeypatch.setattr(strain, "wander_poses", partial(wander_poses, seconds=0.3))
    monkeypatch.setattr(strain, "SIGMAS", (1.0, 5.0))
    for name in ("CONTACT", "SHEAR", "FLOOR", "EXTREME"):
        first = getattr(poses, name)[0]
        monkeypatch.setattr(poses, name, (Key(0.2, first.joints, turn=(-90.0, 0.0, 0.0), hold=0.1),))
