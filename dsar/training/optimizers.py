"""Who moves which parameter, and how fast."""

from collections.abc import Mapping

import torch

from dsar.avatar.avatar import Avatar
from dsar.config import ScheduleConfig
from dsar.training.muon import Muon
from dsar.training.rest import RestOffsets
from dsar.training.schedule import ScheduleState

_TEMPLATE_RATES = {
    "means": 1e-3,
    "quaternions": 5e-3,
    "log_scales": 1e-2,
    "opacity_logits": 5e-2,
    "harmonics": 4e-2,
}


_TRAVEL = 10.0
"""Factor on the means' rate while the template is fitted: the garment's chart is centimetres off."""
_REST_RATE = 3e-3
"""Adam's step of the still frames' offsets, metres."""


def make_optimizers(
    avatar: Avatar, rest: RestOffsets, schedule: ScheduleConfig
) -> Mapping[str, torch.optim.Optimizer]:
    """Return Muon for the network's hidden convolutions and Adam for all else; rates are set each update.

    Adam's epsilon is far below the default: inner gradients of this network are smaller than 1e-8.
    """
    hidden = avatar.network.hidden_weights() if schedule.muon_rate else []
    muon_ids = {id(weight) for weight in hidden}
    adam_weights = [p for p in avatar.network.parameters() if id(p) not in muon_ids]
    groups = [{"params": adam_weights, "name": "network"}]
    groups += [{"params": [p], "name": name} for name, p in avatar.template.named_parameters()]
    groups += [{"params": list(rest.parameters()), "name": "rest"}]
    adam = torch.optim.Adam(groups, lr=0.0, betas=(0.9, 0.99), eps=1e-15, fused=True)
    return {"adam": adam} | ({"muon": Muon(hidden)} if hidden else {})


def set_rates(optimizers: Mapping[str, torch.optim.Optimizer], schedule_state: ScheduleState) -> None:
    """Set the learning rates of this update."""
    fitting = schedule_state.stage == "template"
    rates = {name: rate * schedule_state.template_factor for name, rate in _TEMPLATE_RATES.items()}
    rates["means"] *= _TRAVEL if fitting else 1.0
    rates |= {
        "network": schedule_state.network_rate,
        "rest": _REST_RATE * schedule_state.template_factor * fitting,
    }
    for group in optimizers["adam"].param_groups:
        group["lr"] = rates[group["name"]]
    if "muon" in optimizers:
        for group in optimizers["muon"].param_groups:
            group["lr"] = schedule_state.muon_rate


def keep_still(optimizers: Mapping[str, torch.optim.Optimizer], avatar: Avatar) -> None:
    """Forget the momentum of fixed Gaussians: they get no gradient any more, but would drift on by it."""
    slots = optimizers["adam"].state
    for parameter in avatar.template.parameters():
        if parameter in slots:
            slots[parameter]["exp_avg"][avatar.texel_beneath] = 0.0
