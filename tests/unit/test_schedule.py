"""Stages of training and the rollouts' cursors."""

import numpy as np
import torch

from dsar.config import ScheduleConfig
from dsar.training.optimizers import set_rates
from dsar.training.rollouts import RolloutBatch
from dsar.training.schedule import WHOLE_CLIP, schedule_at


def test_stages_follow_each_other_and_rollouts_only_grow_longer():
    schedule = ScheduleConfig(pose_only_fraction=0.15, max_rollout_frames=16)
    walk = [schedule_at(schedule, i / 1000) for i in range(1000)]
    stages = [p.stage for p in walk]
    assert stages == sorted(stages, key=["template", "pretraining", "pose", "autoregressive"].index)
    assert len(set(stages)) == 4
    lengths = [p.max_rollout_frames for p in walk if p.stage == "autoregressive"]
    assert lengths == sorted(lengths)
    assert lengths[0] == schedule.max_rollout_frames
    assert lengths[-1] == WHOLE_CLIP
    assert sum(h == WHOLE_CLIP for h in lengths) >= 0.45 * len(lengths)
    assert walk[-1].network_rate < 0.03 * schedule.learning_rate


def test_only_a_new_template_travels_far_and_has_shapes_of_its_own_in_still_frames():
    schedule = ScheduleConfig(pose_only_fraction=0.15, max_rollout_frames=16)

    def rates(progress: float) -> tuple[str, dict[str, float]]:
        names = ("means", "quaternions", "log_scales", "opacity_logits", "harmonics", "network", "rest")
        groups = [{"params": [torch.nn.Parameter(torch.zeros(1))], "name": name} for name in names]
        adam = torch.optim.Adam(groups, lr=1.0)
        now = schedule_at(schedule, progress)
        set_rates({"adam": adam}, now)
        return now.stage, {group["name"]: group["lr"] for group in adam.param_groups}

    walk = [rates(i / 1000) for i in range(1000)]
    fitted = [rate for stage, rate in walk if stage == "template"]
    later = [rate for stage, rate in walk if stage != "template"]
    assert min(rate["rest"] for rate in fitted) > 0
    assert max(rate["rest"] for rate in later) == 0
    assert {rate["network"] for rate in fitted} == {0}
    # Beside the other parameters, means move ten times as far as later.
    shares = [
        {round(rate["means"] / rate["quaternions"], 6) for rate in part if rate["quaternions"]}
        for part in (fitted, later)
    ]
    assert shares == [{2.0}, {0.2}]


def test_rollouts_restart_after_the_most_frames_and_at_the_end_of_a_clip():
    rollouts = RolloutBatch({"a": range(0, 10), "b": range(5, 8)}, 3)
    rng = np.random.default_rng(0)
    for _ in range(200):
        cursors, fresh = rollouts.next_frames([rng] * 3, 4)
        for cursor, restarted in zip(cursors, fresh, strict=True):
            assert cursor.frame in rollouts.clips[cursor.sequence]
            assert cursor.age < 4
            assert restarted == (cursor.age == 0)
        rollouts.advance()


def test_a_whole_clip_starts_at_its_first_frame_and_is_seen_to_its_end():
    rollouts = RolloutBatch({"a": range(3, 10)}, 1)
    rng = np.random.default_rng(0)
    seen = []
    for _ in range(14):
        (cursor,), _ = rollouts.next_frames([rng], WHOLE_CLIP)
        seen.append(cursor.frame)
        rollouts.advance()
    # Only the very first start is anywhere, so that several rollouts are out of step.
    first = seen[0]
    assert seen == ([*range(first, 10)] + [*range(3, 10)] * 2)[:14]
