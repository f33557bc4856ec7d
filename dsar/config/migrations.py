"""Settings that were called otherwise once: old config.json files and old flags go on working."""

import logging
from collections.abc import Sequence
from typing import Any

_log = logging.getLogger(__name__)

RENAMED = {
    "model.lags": "model.mean_time_constants",
    "model.identity_channels": "model.uv_feature_channels",
    "model.recall": "model.memory_weight",
    "loss.still_speed": "loss.tau",
    "schedule.template_share": "schedule.template_fraction",
    "schedule.imitation_share": "schedule.pretraining_fraction",
    "schedule.pose_share": "schedule.pose_only_fraction",
    "schedule.half_resolution_share": "schedule.half_resolution_fraction",
    "schedule.streams": "schedule.rollouts_per_worker",
    "schedule.rendered": "schedule.rendered_fraction",
    "schedule.segment": "schedule.chunk_frames",
    "schedule.mirrored": "schedule.mirrored_fraction",
    "schedule.horizon": "schedule.max_rollout_frames",
    "schedule.matrix_rate": "schedule.muon_rate",
    "schedule.refinement": "schedule.finetuning_factor",
    "schedule.clip": "schedule.max_gradient_norm",
}
"""Old and new name of each setting, with its section."""
ADDED = {"model.prior": "none", "loss.residual": 0.0, "schedule.recomputation": "auto"}
"""Settings that came later, and the value by which runs from before go on as they were."""
FORMER_DEFAULTS = ADDED | {"model.mean_time_constants": (0.1, 0.2, 0.4)}
"""What settings were when nobody gave them: a run from then goes on by the command that began it."""
RENAMED_STAGES = {"imitation": "pretraining"}
"""Old and new name of each stage of training, as metrics.jsonl says it."""


def rename_settings(values: Any) -> Any:
    """Return the content of a config.json with the names that settings have now, and those that came later.

    Whatever else it holds stays, for the reader to judge. Where a setting stands by both names, so do both.
    """
    if not isinstance(values, dict):
        return values
    return {
        section: _added(section) | {_new_name(section, name, part): value for name, value in part.items()}
        if isinstance(part, dict)
        else part
        for section, part in values.items()
    }


def _added(section: str) -> dict[str, Any]:
    named = {tuple(setting.split(".")): value for setting, value in ADDED.items()}
    return {name: value for (part, name), value in named.items() if part == section}


def _new_name(section: str, name: str, present: dict[str, Any]) -> str:
    new = RENAMED.get(f"{section}.{name}", "").partition(".")[2]
    return name if not new or new in present else new


def rename_flags(arguments: Sequence[str]) -> list[str]:
    """Return command-line arguments with the names that settings have now; say each new name."""
    return [_renamed_flag(argument) for argument in arguments]


def _renamed_flag(argument: str) -> str:
    flag, equals, value = argument.partition("=")
    new = RENAMED.get(flag.removeprefix("--").replace("-", "_")) if flag.startswith("--") else None
    if new is None:
        return argument
    new = "--" + new.replace("_", "-")
    _log.warning("%s is called %s now", flag, new)
    return new + equals + value
