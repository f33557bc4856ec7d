"""From residual maps to posed Gaussians in one compiled pass, forward and backward, on the CPU.

The same function as sampling, `GaussianParameters.activate` and `pose_gaussians` one after another (the
oracle of its tests), which as separate tensor operations cost more than rasterising the result.
"""

from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from dsar.avatar.bilinear import BilinearSampling
from dsar.avatar.template import SCALE_RANGE, GaussianParameters
from dsar.geometry.harmonics import rotate_harmonics
from dsar.raster.jit import inlined, kernel
from dsar.raster.simd import LANES, broadcast, exp2, load, store
from dsar.types import Gaussians

_FIELDS = 5
"""Of Gaussians, in their order: those of the raw parameters, too."""
_SMALLEST, _LARGEST = map(np.float32, SCALE_RANGE)
_LOG2_E, _LARGEST_POWER = np.float32(1 / np.log(2)), np.float32(126)


def pose_fused(
    template: GaussianParameters,
    offset: Float[Tensor, "b 3 h w"],
    appearance: Float[Tensor, "b a h w"],
    sampling: BilinearSampling,
    axes: Float[Tensor, "n 3 3"],
    blended: Float[Tensor, "b n 3 4"],
    bone_rotations: Float[Tensor, "b n 4"],
    fixed: Bool[Tensor, " n"],
) -> list[Gaussians]:
    """Return the posed Gaussians of each batch entry; float32 in main memory only.

    Args:
        template: raw parameters that the residuals are added to.
        offset: metres along each texel's `axes`.
        appearance: residuals of raw values, as `GaussianParameters.activate` takes them.
        sampling: how each texel is sampled from the maps.
        axes: columns are the offset's axes in the canonical frame.
        blended: the linear blend of bone transforms at each texel.
        bone_rotations: its nearest rotation, unit wxyz.
        fixed: which Gaussians keep their looks, as `GaussianParameters.activate` takes them.
    """
    # Channels fill whole registers.
    room = offset.new_zeros(len(offset), -(3 + appearance.shape[1]) % LANES, *offset.shape[2:])
    values = torch.cat([offset, appearance, room], 1).flatten(2).transpose(1, 2)
    fields = _Pose.apply(
        values, template.means, template.quaternions, template.log_scales, template.opacity_logits,
        template.harmonics, *sampling, axes, fixed, blended, bone_rotations,
    )  # fmt: skip
    posed = []
    for entry, bone_rotation in enumerate(bone_rotations):
        means, rotations, scales, opacities, harmonics = fields[_FIELDS * entry : _FIELDS * (entry + 1)]
        if harmonics.shape[1] > 1:
            harmonics = rotate_harmonics(harmonics[None], bone_rotation[None])[0]
        posed.append(Gaussians(means, rotations, scales, opacities, harmonics))
    return posed


class _Pose(torch.autograd.Function):
    """Values on the grid and raw parameters to the fields of each entry's posed Gaussians, in turn.

    The skeleton gets no gradient. All entries are one node of the graph, so that the gradients of the raw
    parameters, which they share, are added up where they arise.
    """

    @staticmethod
    def forward(ctx: Any, *inputs: Tensor) -> tuple[Tensor, ...]:
        values, *rest = (tensor.detach().contiguous().numpy() for tensor in inputs)
        raw, texels, bones = rest[:_FIELDS], rest[_FIELDS:-2], rest[-2:]
        outputs = [np.empty((len(values), *array.shape), np.float32) for array in raw]
        for entry in range(len(values)):
            posed = [output[entry] for output in outputs]
            _pose(values[entry], *raw, *texels, *(array[entry] for array in bones), *posed)
        ctx.save_for_backward(*inputs)
        ctx.activated = outputs[2:4]
        return tuple(torch.from_numpy(output[entry]) for entry in range(len(values)) for output in outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        values, *rest = (tensor.detach().contiguous().numpy() for tensor in ctx.saved_tensors)
        raw, texels, per_entry = rest[:_FIELDS], rest[_FIELDS:-2], (*rest[-2:], *ctx.activated)
        v_values, v_raw = np.zeros_like(values), [np.zeros_like(array) for array in raw]
        for entry in range(len(values)):
            arriving = gradients[_FIELDS * entry : _FIELDS * (entry + 1)]
            _pose_backward(
                values[entry], raw[1], *texels, *(array[entry] for array in per_entry),
                *(gradient.contiguous().numpy() for gradient in arriving), v_values[entry], *v_raw,
            )  # fmt: skip
        return *map(torch.from_numpy, (v_values, *v_raw)), None, None, None, None, None, None


@kernel
def _pose(
    values, means, quaternions, log_scales, logits, harmonics, cells, weights, axes, fixed, transforms, bones,
    out_means, out_rotations, out_scales, out_opacities, out_harmonics,
):  # fmt: skip
    """Sample the residuals of every texel, add them, activate, and pose."""
    n, bands = harmonics.shape[0], harmonics.shape[1]
    count, flat = values.shape[1], values.reshape(-1)
    r, powers = np.empty(count, np.float32), np.zeros(LANES, np.float32)
    for i in range(n):
        for c in range(0, count, LANES):
            store(r, np.uint64(c), _sample(flat, cells[i], weights[i], count, c))
        if fixed[i]:
            r[3:] = 0
        x = means[i, 0] + axes[i, 0, 0] * r[0] + axes[i, 0, 1] * r[1] + axes[i, 0, 2] * r[2]
        y = means[i, 1] + axes[i, 1, 0] * r[0] + axes[i, 1, 1] * r[1] + axes[i, 1, 2] * r[2]
        z = means[i, 2] + axes[i, 2, 0] * r[0] + axes[i, 2, 1] * r[1] + axes[i, 2, 2] * r[2]
        t = transforms[i]
        for k in range(3):
            out_means[i, k] = t[k, 0] * x + t[k, 1] * y + t[k, 2] * z + t[k, 3]
        bw, bx = quaternions[i, 0] + r[3], quaternions[i, 1] + r[4]
        by, bz = quaternions[i, 2] + r[5], quaternions[i, 3] + r[6]
        inverse = np.float32(1) / max(np.sqrt(bw * bw + bx * bx + by * by + bz * bz), np.float32(1e-12))
        bw, bx, by, bz = bw * inverse, bx * inverse, by * inverse, bz * inverse
        aw, ax, ay, az = bones[i, 0], bones[i, 1], bones[i, 2], bones[i, 3]
        out_rotations[i, 0] = aw * bw - ax * bx - ay * by - az * bz
        out_rotations[i, 1] = aw * bx + ax * bw + ay * bz - az * by
        out_rotations[i, 2] = aw * by - ax * bz + ay * bw + az * bx
        out_rotations[i, 3] = aw * bz + ax * by - ay * bx + az * bw
        for k in range(3):
            powers[k] = _exponent(log_scales[i, k] + r[7 + k])
        powers[3] = _exponent(-(logits[i] + r[10]))
        exponents = load(powers, np.uint64(0))
        store(powers, np.uint64(0), exp2(exponents))
        for k in range(3):
            # Written so that NaN passes through: a value that is not finite must not look sound.
            raw = log_scales[i, k] + r[7 + k]
            scale = powers[k] if raw == raw else raw
            scale = _SMALLEST if scale < _SMALLEST else scale
            out_scales[i, k] = _LARGEST if scale > _LARGEST else scale
        raw = logits[i] + r[10]
        out_opacities[i] = np.float32(1) / (np.float32(1) + powers[3]) if raw == raw else raw
        for b in range(bands):
            for k in range(3):
                out_harmonics[i, b, k] = harmonics[i, b, k] + r[11 + 3 * b + k]


@kernel
def _pose_backward(
    values, quaternions, cells, weights, axes, fixed, transforms, bones, scales, opacities,
    v_means, v_rotations, v_scales, v_opacities, v_harmonics,
    out_values, out_means, out_quaternions, out_log_scales, out_logits, out_harmonics,
):  # fmt: skip
    """Add the gradients of posed Gaussians to those of raw parameters, and of the grid's cells."""
    n, bands = v_harmonics.shape[0], v_harmonics.shape[1]
    count, flat, out_flat = values.shape[1], values.reshape(-1), out_values.reshape(-1)
    r, sampled = np.zeros(count, np.float32), np.empty(LANES, np.float32)
    for i in range(n):
        store(sampled, np.uint64(0), _sample(flat, cells[i], weights[i], count, 0))
        t = transforms[i]
        gx, gy, gz = v_means[i, 0], v_means[i, 1], v_means[i, 2]
        x = t[0, 0] * gx + t[1, 0] * gy + t[2, 0] * gz
        y = t[0, 1] * gx + t[1, 1] * gy + t[2, 1] * gz
        z = t[0, 2] * gx + t[1, 2] * gy + t[2, 2] * gz
        for k in range(3):
            r[k] = axes[i, 0, k] * x + axes[i, 1, k] * y + axes[i, 2, k] * z
        if fixed[i]:
            r[3:] = 0
        else:
            out_means[i, 0] += x
            out_means[i, 1] += y
            out_means[i, 2] += z
            bw, bx = quaternions[i, 0] + sampled[3], quaternions[i, 1] + sampled[4]
            by, bz = quaternions[i, 2] + sampled[5], quaternions[i, 3] + sampled[6]
            inverse = np.float32(1) / max(np.sqrt(bw * bw + bx * bx + by * by + bz * bz), np.float32(1e-12))
            bw, bx, by, bz = bw * inverse, bx * inverse, by * inverse, bz * inverse
            # The gradient is rotated back with the conjugate of the bone's rotation.
            aw, ax, ay, az = bones[i, 0], -bones[i, 1], -bones[i, 2], -bones[i, 3]
            pw, px, py, pz = v_rotations[i, 0], v_rotations[i, 1], v_rotations[i, 2], v_rotations[i, 3]
            qw = aw * pw - ax * px - ay * py - az * pz
            qx = aw * px + ax * pw + ay * pz - az * py
            qy = aw * py - ax * pz + ay * pw + az * px
            qz = aw * pz + ax * py - ay * px + az * pw
            radial = bw * qw + bx * qx + by * qy + bz * qz
            r[3], r[4] = (qw - bw * radial) * inverse, (qx - bx * radial) * inverse
            r[5], r[6] = (qy - by * radial) * inverse, (qz - bz * radial) * inverse
            for k in range(3):
                free = _SMALLEST < scales[i, k] < _LARGEST
                r[7 + k] = v_scales[i, k] * scales[i, k] if free else np.float32(0)
            r[10] = v_opacities[i] * opacities[i] * (np.float32(1) - opacities[i])
            for b in range(bands):
                for k in range(3):
                    r[11 + 3 * b + k] = v_harmonics[i, b, k]
                    out_harmonics[i, b, k] += v_harmonics[i, b, k]
            for k in range(4):
                out_quaternions[i, k] += r[3 + k]
            for k in range(3):
                out_log_scales[i, k] += r[7 + k]
            out_logits[i] += r[10]
        for c in range(0, count, LANES):
            gradient = load(r, np.uint64(c))
            for k in range(4):
                place = np.uint64(cells[i, k]) * np.uint64(count) + np.uint64(c)
                store(out_flat, place, load(out_flat, place) + weights[i, k] * gradient)


@inlined
def _sample(values, cells, weights, count, channel):
    """Return the LANES values of a texel from a channel on, from the four cells around it."""
    total = broadcast(np.float32(0))
    for k in range(4):
        place = np.uint64(cells[k]) * np.uint64(count) + np.uint64(channel)
        total += weights[k] * load(values, place)
    return total


@inlined
def _exponent(value):
    """Return the power of 2 that is e to a value, brought into the range of `exp2`."""
    power = value * _LOG2_E
    power = _LARGEST_POWER if power > _LARGEST_POWER else power
    return -_LARGEST_POWER if power < -_LARGEST_POWER else power
