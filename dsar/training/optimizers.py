"""Who moves which parameter, and how fast."""

from collections.abc import Mapping

import torch

from dsar.avatar.avatar import Avatar
from dsar.config import ScheduleConfig
from dsar.training.muon import Muon
from dsar.training.stages import Position

_TEMPLATE_RATES = {
    "means": 1e-3,
    "quaternions": 5e-3,
    "log_scales": 1e-2,
    "opacity_logits": 5e-2,
    "harmonics": 4e-2,
}


def make_optimizers(avatar: Avatar, schedule: ScheduleConfig) -> Mapping[str, torch.optim.Optimizer]:
    """Return Muon for the network's hidden convolutions and Adam for all else; rates are set each update.

    Adam's epsilon is far below the default: inner gradients of this network are smaller than 1e-8.
    """
    hidden = avatar.network.hidden_weights() if schedule.matrix_rate else []
    chosen = {id(weight) for weight in hidden}
    rest = [p for p in avatar.network.parameters() if id(p) not in chosen]
    groups = [{"params": rest, "name": "network"}]
    groups += [{"params": [p], "name": name} for name, p in avatar.template.named_parameters()]
    adam = torch.optim.Adam(groups, lr=0.0, betas=(0.9, 0.99), eps=1e-15, fused=True)
    return {"adam": adam} | ({"muon": Muon(hidden)} if hidden else {})


def set_rates(optimizers: Mapping[str, torch.optim.Optimizer], now: Position) -> None:
    """Set the learning rates of this update."""
    for group in optimizers["adam"].param_groups:
        name = group["name"]
        group["lr"] = now.network_rate if name == "network" else _TEMPLATE_RATES[name] * now.template_factor
    if "muon" in optimizers:
        for group in optimizers["muon"].param_groups:
            group["lr"] = now.matrix_rate
