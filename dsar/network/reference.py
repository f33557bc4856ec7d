"""The paper's dual-stream architecture (section 3.4) as its text reads: no cache, no variants, nothing fused.

It defines what `dsar.network` must compute, for training's step and the inference session alike, and reads
from top to bottom beside the paper. Every frame of the window is encoded at every step, all rows of the
attention are computed under its causal mask, keys and values of the bank are projected anew, and maps are
doubled before they are convolved.

Symbols: b rollouts of a batch, n frames of the window (oldest first, the last is t), m entries of the bank,
L levels (the first the finest), h and w of the network's maps.
"""

from collections.abc import Iterable, Sequence
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import adaptive_avg_pool2d, conv2d, interpolate, leaky_relu, linear

from dsar.network.decoder import Decoder
from dsar.network.layers import SLOPE, ConvBlock, Upsample
from dsar.network.model import OFFSET_UNIT, DualStreamNetwork, NetworkOutput
from dsar.network.temporal import TemporalAggregation, TemporalAttention

T = TypeVar("T")


class ReferenceNetwork(nn.Module):
    """Psi: one time step of a batch of rollouts, from the whole history that it depends on.

    The parameters are those of a network of the paper's wiring, bank and readout; the decoder's upsampling
    alone has 3x3 kernels of its own, of which the network's are a folded form (`fold_doubling`).
    """

    def __init__(
        self, network: DualStreamNetwork, doubling_kernels: Sequence[Float[Tensor, "_ _ 3 3"]]
    ) -> None:
        """`doubling_kernels` follow each doubling of the decoder, finest level first."""
        super().__init__()
        self.network = network
        self.doubling_kernels = nn.ParameterList(doubling_kernels)

    def forward(
        self,
        maps: Float[Tensor, "b n c h w"],
        magnitudes: Float[Tensor, "b n 1 h w"],
        previous_offset: Float[Tensor, "b 3 h w"],
        memory: Float[Tensor, "b m d hL wL"] | None,
    ) -> tuple[NetworkOutput, Float[Tensor, "b m d hL wL"]]:
        """Return dG_t with F_t, and M_{t+1}.

        Args:
            maps: Position p and velocity dp of the window's frames, standardised; a configuration may add
                accelerations and the like (extension).
            magnitudes: Their motion magnitudes V (equation 6), standardised.
            previous_offset: dmu_{t-1}, metres.
            memory: M_t, oldest first; None at the first step.
        """
        return self.predict(self.concatenate(maps, previous_offset), magnitudes, memory)

    def predict(
        self,
        inputs: Float[Tensor, "b n i h w"],
        magnitudes: Float[Tensor, "b n 1 h2 w2"],
        memory: Float[Tensor, "b m d hL wL"] | None,
    ) -> tuple[NetworkOutput, Float[Tensor, "b m d hL wL"]]:
        """Return dG_t with F_t, and M_{t+1}, from the inputs I of the window's frames."""
        features = self.encode(inputs)
        tokens = self.enhance(features[-1], magnitudes)
        aggregate = self.attend_causally(tokens)
        hidden, next_memory = self.remember(aggregate, memory)
        hierarchy = self.aggregate_levels(features, hidden)
        return self.decode(hierarchy), next_memory

    def concatenate(
        self, maps: Float[Tensor, "b n c h w"], previous_offset: Float[Tensor, "b 3 h w"]
    ) -> Float[Tensor, "b n i h w"]:
        """Return I_tau = Concat[p_tau, dp_tau, dmu_{t-1}] of every frame (equation 4).

        The previous offset is shared by all frames of the window. Learned UV features come last, if the
        network has any (extension).
        """
        b, n = maps.shape[:2]
        parts = [maps, (previous_offset / OFFSET_UNIT)[:, None].expand(b, n, -1, -1, -1)]
        if self.network.encoder.uv_features is not None:
            parts.append(self.network.encoder.uv_features[None].expand(b, n, -1, -1, -1))
        return torch.cat(parts, 2)

    def encode(self, inputs: Float[Tensor, "b n i h w"]) -> list[Float[Tensor, "b n _ _ _"]]:
        """Return the pyramids {f^l_tau}, l = 1 the finest, of every frame by itself (equation 5)."""
        pyramid, x = self.network.encoder.pyramid, inputs.flatten(0, 1)
        levels = [convolve(pyramid.second, convolve(pyramid.first, x))]
        for block in typed(ConvBlock, pyramid.deeper):
            levels.append(convolve_twice(block, levels[-1]))
        return [level.unflatten(0, inputs.shape[:2]) for level in levels]

    @staticmethod
    def motion_magnitude(velocity: Float[Tensor, "*b 3 h w"]) -> Float[Tensor, "*b 1 h w"]:
        """Return V[u, v] = |dp[u, v]|_2 (equation 6), in the unit of the velocities."""
        return velocity.square().sum(-3, keepdim=True).sqrt()

    def embed_motion(
        self, magnitudes: Float[Tensor, "b n 1 h w"], size: tuple[int, int]
    ) -> Float[Tensor, "b n d hL wL"]:
        """Return m_tau = Phi_m(V_tau) of every frame, at the coarsest level's size (equation 7)."""
        motion_embedding = self.network.motion_embedding
        assert motion_embedding is not None
        pooled = adaptive_avg_pool2d(magnitudes.flatten(0, 1), size)
        x, out = convolve_twice(motion_embedding.block, pooled), motion_embedding.out
        return conv2d(x, out.weight, out.bias, padding=1).unflatten(0, magnitudes.shape[:2])

    def enhance(
        self, features: Float[Tensor, "b n d hL wL"], magnitudes: Float[Tensor, "b n 1 h w"]
    ) -> Float[Tensor, "b n d hL wL"]:
        """Return f~^L_tau = f^L_tau + m_tau + e_tau (equation 8)."""
        motion = self.embed_motion(magnitudes, (features.shape[-2], features.shape[-1]))
        return features + motion + self.network.attention.position_embedding[:, :, None, None]

    def attend_causally(self, tokens: Float[Tensor, "b n d h w"]) -> Float[Tensor, "b d h w"]:
        """Return A_t, the newest row of the causal self-attention over the window (equations 9, 10, 11)."""
        n = tokens.shape[1]
        # M_causal[tau, tau'] is -inf where tau < tau' (equation 10).
        causal_mask = tokens.new_full((n, n), -torch.inf).triu(1)
        return attend(self.network.attention, tokens, tokens, causal_mask)[:, -1]

    def remember(
        self, aggregate: Float[Tensor, "b d h w"], memory: Float[Tensor, "b m d h w"] | None
    ) -> tuple[Float[Tensor, "b d h w"], Float[Tensor, "b m d h w"]]:
        """Return h_t and M_{t+1} (equations 12, 13, 14).

        The first step has no h_{t-1}: it looks into copies of A_1, and leaves copies of h_1.
        """
        bank, m = self.network.bank, self.network.config.memory
        assert bank is not None
        entries = repeat(aggregate, m) if memory is None else memory
        keys_values = entries + bank.attention.position_embedding[:, :, None, None]
        # h*_t = CrossAttn(Q = A_t, KV = M_t) (equation 12).
        retrieved = attend(bank.attention, aggregate[:, None], keys_values)[:, 0]
        # h_t = (1 - lambda) A_t + lambda h*_t (equation 13).
        weight = torch.sigmoid(bank.memory_logit)
        hidden = (1 - weight) * aggregate + weight * retrieved
        # M_{t+1} = {h_{t-m+1}, ..., h_{t-1}, h_t} (equation 14).
        if memory is None:
            return hidden, repeat(hidden, m)
        return hidden, torch.cat([memory[:, 1:], hidden[:, None]], 1)

    def aggregate_levels(
        self, features: Sequence[Float[Tensor, "b n _ _ _"]], hidden: Float[Tensor, "b d hL wL"]
    ) -> list[Float[Tensor, "b _ _ _"]]:
        """Return F^l_t = Phi^l_agg({f^l_tau}) for l < L, and F^L_t = h_t (equation 15)."""
        hierarchy = []
        for level, frames in zip(
            typed(TemporalAggregation, self.network.aggregation), features, strict=False
        ):
            filtered = (frames * level.weights[:, :, None, None]).sum(1)
            hierarchy.append(conv2d(filtered, level.mix.weight, level.mix.bias))
        return [*hierarchy, hidden]

    def decode(self, hierarchy: Sequence[Float[Tensor, "b _ _ _"]]) -> NetworkOutput:
        """Return dG_t = Psi_dec({F^l_t}) (equation 16); offsets are bounded, in metres, zero off charts."""
        config, raw = self.network.config, self.upsample(hierarchy)
        bounded = config.offset_limit * torch.tanh(raw[:, :3] * config.offset_scale / config.offset_limit)
        offset = bounded * self.network.occupied
        return NetworkOutput(offset, config.appearance_scale * raw[:, 3:], tuple(hierarchy))

    def upsample(self, hierarchy: Sequence[Float[Tensor, "b _ _ _"]]) -> Float[Tensor, "b o h w"]:
        """Return the U-Net's output: at each level double, convolve, join the skip, convolve twice."""
        decoder, x = self.network.decoder, hierarchy[-1]
        assert isinstance(decoder, Decoder)
        ups, blocks = typed(Upsample, decoder.ups), typed(ConvBlock, decoder.blocks)
        for level in reversed(range(len(ups))):
            kernel, bias = self.doubling_kernels[level], ups[level].conv.bias
            doubled = interpolate(x, scale_factor=2, mode="nearest")
            x = leaky_relu(conv2d(doubled, kernel, bias, padding=1), SLOPE)
            x = convolve_twice(blocks[level], torch.cat([x, hierarchy[level]], 1))
        return conv2d(x, decoder.head.weight, decoder.head.bias, padding=1)


class ReferenceRollout:
    """A batch of rollouts from frame to frame: window, previous offset and memory bank."""

    def __init__(self, network: ReferenceNetwork) -> None:
        self.network = network
        self.window: list[tuple[Tensor, Tensor]] = []
        self.previous_offset: Tensor | None = None
        self.memory: Tensor | None = None

    def step(self, maps: Float[Tensor, "b c h w"], magnitude: Float[Tensor, "b 1 h w"]) -> NetworkOutput:
        """Advance by one frame. Before the first the body stood still in it, and nothing was offset."""
        n = self.network.network.config.window
        frame = (maps, magnitude)
        self.window = [*(self.window or [frame] * n), frame][-n:]
        if self.previous_offset is None:
            self.previous_offset = torch.zeros_like(maps[:, :3])
        window_maps, magnitudes = (torch.stack(frames, 1) for frames in zip(*self.window, strict=True))
        output, self.memory = self.network(window_maps, magnitudes, self.previous_offset, self.memory)
        self.previous_offset = output.offset
        return output


def attend(
    attention: TemporalAttention,
    queries: Float[Tensor, "b q d h w"],
    frames: Float[Tensor, "b n d h w"],
    mask: Float[Tensor, "q n"] | float = 0.0,
) -> Float[Tensor, "b q d h w"]:
    """Return softmax(Q K^T / sqrt(d_k) + M) V for every row, at each pixel and head (equations 9, 11)."""
    b, _, d, h, w = frames.shape

    def project(layer: nn.Conv2d, x: Tensor) -> Tensor:
        x = linear(x.movedim(2, -1).reshape(b, -1, h * w, d), layer.weight[:, :, 0, 0], layer.bias)
        return x.reshape(b, -1, h * w, attention.heads, d // attention.heads).permute(0, 2, 3, 1, 4)

    q, k, v = (
        project(attention.query, queries),
        project(attention.key, frames),
        project(attention.value, frames),
    )
    rows = (q @ k.mT / k.shape[-1] ** 0.5 + mask).softmax(-1) @ v
    rows = rows.permute(0, 3, 1, 2, 4).reshape(b, -1, h * w, d)
    rows = linear(rows, attention.out.weight[:, :, 0, 0], attention.out.bias)
    return rows.reshape(b, -1, h, w, d).movedim(-1, 2)


def convolve(layer: nn.Conv2d, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b d h2 w2"]:
    """Return x after a 3x3 convolution and a leaky ReLU."""
    return leaky_relu(conv2d(x, layer.weight, layer.bias, stride=layer.stride[0], padding=1), SLOPE)


def convolve_twice(block: ConvBlock, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b d h2 w2"]:
    """Return x after a block's two convolutions."""
    return convolve(block.second, convolve(block.first, x))


def repeat(entry: Float[Tensor, "b d h w"], m: int) -> Float[Tensor, "b m d h w"]:
    """Return m copies of an entry of the bank."""
    return entry[:, None].repeat(1, m, 1, 1, 1)


def doubling_kernels(network: DualStreamNetwork) -> list[Float[Tensor, "_ _ 3 3"]]:
    """Draw kernels for a decoder's doublings, finest level first."""
    assert isinstance(network.decoder, Decoder)
    kernels = []
    for up in typed(Upsample, network.decoder.ups):
        deep, shallow = up.conv.weight.shape[:2]
        kernels.append(torch.randn(shallow, deep, 3, 3).to(up.conv.weight) * (2 / (9 * deep)) ** 0.5)
    return kernels


def fold_doubling(kernel: Float[Tensor, "d c 3 3"]) -> Float[Tensor, "c d 4 4"]:
    """Return the transposed convolution of stride 2 that is nearest-neighbour doubling and then a kernel."""
    # The same along one axis.
    fold = kernel.new_tensor([[0.0, 0, 1], [0, 1, 1], [1, 1, 0], [1, 0, 0]])
    return torch.einsum("ak,oikl,bl->ioab", fold, kernel, fold)


def typed(kind: type[T], modules: Iterable[nn.Module]) -> list[T]:
    """Return modules, all of which are of one kind."""
    return [module for module in modules if isinstance(module, kind)]
