"""Small networks with random inputs, and the variants that their tests go through."""

import torch

from dsar.config import ModelConfig
from dsar.network import DualStreamNetwork, NetworkState, build_network

SMALL = ModelConfig(
    window=4,
    memory=3,
    mean_time_constants=(0.1, 0.2, 0.4),
    channels=(4, 8),
    heads=2,
    uv_feature_channels=2,
)
SIZE = (8, 12)
WIRINGS = ("perframe", "late", "shared")
VARIANTS = {
    "paper": {},
    "three offsets": {"feedback": 3},
    "no offsets": {"feedback": 0},
    "no bank": {"memory": 0},
    "bank of features": {"bank": "features", "memory": 1},
    "mean of rows": {"readout": "mean"},
    "bidirectional": {"readout": "mean", "causal": False},
    "no motion embedding": {"motion_embedding": False},
    "no UV features": {"uv_feature_channels": 0},
    "pixel shuffle": {"pixel_shuffle": 2},
    "one frame": {"window": 1},
}


def build(config: ModelConfig, *, trained: bool = True) -> DualStreamNetwork:
    torch.manual_seed(0)
    occupied = torch.ones(SIZE, dtype=torch.bool)
    occupied[0, :2] = False
    network = build_network(config, occupied)
    if trained:
        torch.nn.init.normal_(network.decoder.head.weight, std=0.1)
    return network


def inputs(config: ModelConfig, frames: int, batch: int = 2) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    maps = torch.randn(frames, batch, config.map_channels, *SIZE, generator=generator)
    speed = torch.rand(frames, batch, 1, *SIZE, generator=generator)
    return maps, speed


def roll(network, maps, speed, state: NetworkState | None = None, **options):
    """Return the outputs of training's steps, and the last state."""
    state = state or network.initial_state(maps.shape[1])
    outputs = []
    for frame in range(len(maps)):
        output, state = network(maps[frame], speed[frame], state, **options)
        outputs.append(output)
    return outputs, state
