"""The kernel of :mod:`neurad.losses.leave_one_out` for a GPU, by NVIDIA Warp: colours of three channels, float32.

Imported where samples on a GPU need it. A thread serves a pixel.
"""
# mypy: disable-error-code="attr-defined, valid-type, arg-type, return-value, no-untyped-call"
# No postponed annotations here: Warp reads the argument types when a kernel is declared.

import torch
import warp as wp
from torch import Tensor

from neurad.runtime.warp import launch

wp.set_module_options({"enable_backward": False})


@wp.func
def group_mean(values: wp.array2d(dtype=wp.vec3), pixel: int, first: int, size: int) -> wp.vec3:
    """Mean of a pixel's ``values`` from the first of a group."""
    total = wp.vec3()
    for k in range(first, first + size):
        total += values[pixel, k]
    return total / float(size)


@wp.kernel
def leave_one_out(
    samples: wp.array2d(dtype=wp.vec3),
    target: wp.array(dtype=wp.vec3),
    weight: wp.array(dtype=wp.vec3),
    censored: wp.array2d(dtype=wp.bool),
    light: wp.array2d(dtype=wp.vec3),
    deviation: wp.array2d(dtype=wp.vec3),
    groups: int,
    chroma: float,
    unit: float,
    value: wp.array(dtype=wp.vec2),
    by_sample: wp.array2d(dtype=wp.vec3),
    by_deviation: wp.array2d(dtype=wp.vec3),
) -> None:
    """What each pixel adds to surrogate and loss, ``value`` [b], and the surrogate's derivatives [b, n].

    ``light`` and ``deviation`` [b, n] are a control variate's; empty without one. ``censored`` [b, 3] marks targets
    that are a lower bound; empty for none. ``unit`` is 1 over the number of residuals.
    """
    pixel = wp.tid()
    size = samples.shape[1] // groups
    controlled = light.shape[0] > 0
    rest = 1.0 / float(groups - 1)
    pairs = wp.where(groups > 2, 1.0 / float((groups - 1) * wp.max(groups - 2, 1)), 0.0)

    total_s, total_l, total_z, total_lz = wp.vec3(), wp.vec3(), wp.vec3(), wp.vec3()
    for i in range(groups):
        total_s += group_mean(samples, pixel, i * size, size)
        if controlled:
            mean_l = group_mean(light, pixel, i * size, size)
            mean_z = group_mean(deviation, pixel, i * size, size)
            total_l += mean_l
            total_z += mean_z
            total_lz += wp.cw_mul(mean_l, mean_z)

    aim, root, bounding = target[pixel], wp.vec3(), wp.vec3()  # weights of what is exact and of what is a bound
    for c in range(3):
        clipped = wp.bool(False)
        if censored.shape[0] > 0:
            clipped = censored[pixel, c]
        if clipped:
            bounding[c] = weight[pixel][c]
        else:
            root[c] = wp.sqrt(weight[pixel][c])

    surrogate, loss = wp.float32(0.0), wp.float32(0.0)
    for i in range(groups):
        # Residual by the other groups, and this group's mean
        own = group_mean(samples, pixel, i * size, size)
        others = (total_s - own) * rest
        baseline = wp.vec3()
        if controlled:
            mean_l = group_mean(light, pixel, i * size, size)
            mean_z = group_mean(deviation, pixel, i * size, size)
            light_of_others, z_of_others = total_l - mean_l, total_z - mean_z
            lz_of_others = total_lz - wp.cw_mul(mean_l, mean_z)
            others -= (wp.cw_mul(light_of_others, z_of_others) - lz_of_others) * pairs
            baseline = light_of_others * rest
            own -= wp.cw_mul(baseline, mean_z)
        # Relative to the normaliser; what is censored counts by channel, below its bound
        relative = wp.cw_mul(root, others - aim)
        shared = (chroma - 1.0) / 3.0 * (relative[0] + relative[1] + relative[2])
        gradient = 2.0 * wp.cw_mul(root, chroma * relative - wp.vec3(shared, shared, shared))
        gradient += 2.0 * wp.cw_mul(bounding, wp.min(others - aim, wp.vec3()))
        surrogate += wp.dot(gradient, own)
        loss += 0.5 * wp.dot(gradient, own - aim)
        gradient *= unit / float(size)
        for k in range(i * size, (i + 1) * size):
            by_sample[pixel, k] = gradient
            if controlled:
                by_deviation[pixel, k] = -wp.cw_mul(gradient, baseline)
    value[pixel] = wp.vec2(surrogate, loss) * unit


def find(
    samples: Tensor,
    deviation: Tensor,
    target: Tensor,
    weight: Tensor,
    censored: Tensor | None,
    light: Tensor,
    by_sample: Tensor,
    by_deviation: Tensor,
    groups: int,
    chroma: float,
) -> tuple[Tensor, Tensor]:
    """Surrogate and loss; fills ``by_sample`` and ``by_deviation`` with the surrogate's derivatives.

    The arguments are those of :func:`neurad.losses.leave_one_out.leave_one_out`, contiguous; ``light`` and
    ``deviation`` are a control variate's, empty without one.
    """
    value = samples.new_empty(len(samples), 2)
    bounds = samples.new_empty(0, 3, dtype=torch.bool) if censored is None else censored.contiguous()
    launch(
        leave_one_out, len(samples), samples.device, samples, target, weight, bounds, light, deviation,
        groups, chroma, 1.0 / (len(samples) * groups * 3), value, by_sample, by_deviation,
    )  # fmt: skip
    surrogate, loss = value.sum(0).unbind()
    return surrogate, loss
