"""From a configuration to a network: the one place that knows the variants."""

from jaxtyping import Bool
from torch import Tensor

from dsar.config import ModelConfig
from dsar.network.decoder import Decoder, ResidualDecoder
from dsar.network.encoder import SharedOffsetEncoder, WindowEncoder
from dsar.network.memory import MemoryBank
from dsar.network.model import DualStreamNetwork
from dsar.network.pyramid import level_size
from dsar.network.readout import NewestRow
from dsar.network.temporal import MotionEmbedding, TemporalAggregation, TemporalAttention
from dsar.network.variants.feature_bank import FeatureBank
from dsar.network.variants.linear_bases import LinearBases
from dsar.network.variants.mean_readout import MeanOfRows
from dsar.network.variants.offset_wiring import LateOffsetEncoder, PerFrameOffsetEncoder

_ENCODERS: dict[str, type[WindowEncoder]] = {
    "shared": SharedOffsetEncoder,
    "late": LateOffsetEncoder,
    "perframe": PerFrameOffsetEncoder,
}
_BANKS: dict[str, type[MemoryBank]] = {"hidden": MemoryBank, "features": FeatureBank}


def build_network(config: ModelConfig, occupied: Bool[Tensor, "h w"]) -> DualStreamNetwork:
    """Return an untrained network; `occupied` are the cells of its maps that hold Gaussians.

    Random numbers are drawn in the order in which the parts are made.
    """
    channels, deepest, fine = config.channels, config.channels[-1], config.pixel_shuffle
    grid = (occupied.shape[0] // fine, occupied.shape[1] // fine)
    memory = (config.heads, config.memory, config.memory_weight)
    return DualStreamNetwork(
        config,
        occupied,
        encoder=_ENCODERS[config.wiring](config, grid),
        motion_embedding=MotionEmbedding(deepest) if config.motion_embedding else None,
        attention=TemporalAttention(deepest, config.heads, config.window),
        readout=MeanOfRows(causal=config.causal) if config.readout == "mean" else NewestRow(),
        bank=_BANKS[config.bank](deepest, *memory) if config.memory else None,
        aggregation=[TemporalAggregation(c, config.window) for c in channels[:-1]],
        decoder=_build_decoder(config, grid),
    )


def _build_decoder(config: ModelConfig, grid: tuple[int, int]) -> ResidualDecoder:
    outputs = config.pixel_shuffle**2 * (3 + config.appearance_channels)
    if not config.bases:
        return Decoder(config.channels, outputs)
    height, width = level_size(grid, len(config.channels) - 1)
    return LinearBases(config.channels[-1] * height * width, outputs, grid, config.bases)
