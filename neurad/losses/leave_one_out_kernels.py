"""Compiled form of :func:`neurad.losses.leave_one_out.leave_one_out`."""

import numpy as np

from neurad.core.records import FloatArray
from neurad.runtime.jit import kernel

_ZERO, _HALF, _ONE, _TWO = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)


@kernel
def leave_one_out(
    low: int,
    high: int,
    groups: int,
    chroma: float,
    room: FloatArray,
    samples: FloatArray,
    target: FloatArray,
    weight: FloatArray,
    light: FloatArray,
    deviation: FloatArray,
    by_sample: FloatArray,
    by_deviation: FloatArray,
) -> tuple[float, float]:  # pragma: no cover - compiled
    """What pixels ``low .. high - 1`` add to surrogate and loss for ``samples`` [b, n, c], ``target`` and ``weight``
    [b, c]; the surrogate's derivatives are written to ``by_sample`` and ``by_deviation`` [b, n, c].

    ``light`` and ``deviation`` [b, n, c] are a control variate's; empty without one. Of the residual relative to the
    normaliser what channels differ by counts ``chroma`` times. ``room`` [3 + 4 c, groups] is memory to work in.
    """
    pixels, count, channels = samples.shape
    controlled = light.shape[0] > 0
    of_group = count // groups
    inverse_size, rest = _ONE / np.float32(of_group), _ONE / np.float32(groups - 1)
    pairs = _ONE / np.float32((groups - 1) * (groups - 2)) if groups > 2 else _ZERO
    unit = 1.0 / (pixels * groups * channels)
    mean_s, mean_l, mean_z = room[0], room[1], room[2]
    relative, own = room[3:], room[3 + channels :]
    baseline, root = room[3 + 2 * channels :], room[3 + 3 * channels :]
    by_channel, excess = np.float32(chroma), np.float32((chroma - 1.0) / channels)
    surrogate, loss = 0.0, 0.0
    for p in range(low, high):
        # Residuals by the other groups, relative to the normaliser
        for c in range(channels):
            total_s, total_l, total_z, total_lz = _ZERO, _ZERO, _ZERO, _ZERO
            for i in range(groups):
                sum_s, sum_l, sum_z = _ZERO, _ZERO, _ZERO
                for k in range(i * of_group, (i + 1) * of_group):
                    sum_s += samples[p, k, c]
                    if controlled:
                        sum_l += light[p, k, c]
                        sum_z += deviation[p, k, c]
                mean_s[i], mean_l[i], mean_z[i] = inverse_size * sum_s, inverse_size * sum_l, inverse_size * sum_z
                total_s += mean_s[i]
                total_l += mean_l[i]
                total_z += mean_z[i]
                total_lz += mean_l[i] * mean_z[i]
            root[c, 0] = np.sqrt(weight[p, c])
            for i in range(groups):
                others, light_of_others = (total_s - mean_s[i]) * rest, (total_l - mean_l[i]) * rest
                others -= ((total_l - mean_l[i]) * (total_z - mean_z[i]) - (total_lz - mean_l[i] * mean_z[i])) * pairs
                relative[c, i] = root[c, 0] * (others - target[p, c])
                own[c, i] = mean_s[i] - light_of_others * mean_z[i]
                baseline[c, i] = light_of_others
        # Gradients
        for i in range(groups):
            shared = _ZERO
            for c in range(channels):
                shared += relative[c, i]
            for c in range(channels):
                factor = _TWO * root[c, 0] * (by_channel * relative[c, i] - excess * shared)
                surrogate += factor * own[c, i]
                loss += _HALF * factor * (own[c, i] - target[p, c])
                gradient = np.float32(factor * unit) * inverse_size
                for k in range(i * of_group, (i + 1) * of_group):
                    by_sample[p, k, c] = gradient
                    if controlled:
                        by_deviation[p, k, c] = -gradient * baseline[c, i]
    return surrogate * unit, loss * unit
