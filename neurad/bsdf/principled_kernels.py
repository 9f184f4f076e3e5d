"""Compiled CPU twins of the plain-torch formulas in ``principled`` and ``microfacet``: one pass over the lanes.

All arithmetic is float32. Mathematical steps are explained there, not here. The kernels release the GIL, run on the
calling thread and are compiled once per machine.
"""

import math

import numpy as np

from neurad.bsdf.sampling_kernels import concentric_disk
from neurad.core.records import FloatArray
from neurad.runtime.jit import fastmath_kernel, inlined, kernel

_INV_PI = np.float32(1.0 / math.pi)
_ZERO, _HALF, _ONE, _TWO = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)
_QUARTER, _FOUR = np.float32(0.25), np.float32(4.0)
_MIN_ALPHA, _TINY = np.float32(0.001), np.float32(1e-6)


@inlined
def _ggx(
    zo: np.float32, zi: np.float32, flat: np.float32, up: np.float32, r: np.float32
) -> tuple[np.float32, ...]:  # pragma: no cover - compiled
    """Factors of the GGX reflection ``density zi inv_o inv_i``, the first its distribution, and its logarithmic
    derivative by the roughness; ``flat`` and ``up`` are both parts of the squared length of ``wo + wi``.
    """
    wide = r * r > _MIN_ALPHA
    alpha = r * r if wide else _MIN_ALPHA
    alpha2 = alpha * alpha
    inv_denominator = _ONE / (flat + alpha2 * up)
    ratio = (flat + up) * inv_denominator
    density = alpha2 * ratio * ratio * _INV_PI
    zo2, zi2 = zo * zo, zi * zi
    root_o, root_i = math.sqrt(zo2 + alpha2 * (_ONE - zo2)), math.sqrt(zi2 + alpha2 * (_ONE - zi2))
    inv_o, inv_i = _ONE / (zo + root_o), _ONE / (zi + root_i)
    log_by_alpha = (
        _TWO / alpha
        - _FOUR * alpha * up * inv_denominator
        - alpha * ((_ONE - zo2) / root_o * inv_o + (_ONE - zi2) / root_i * inv_i)
    )
    return density, inv_o, inv_i, log_by_alpha * _TWO * r if wide else _ZERO


@inlined
def _correlated(
    zo: np.float32, zi: np.float32, r: np.float32, inv_o: np.float32, inv_i: np.float32
) -> tuple[np.float32, np.float32]:  # pragma: no cover - compiled
    """By how much more than 1 correlated masking and shadowing multiply the GGX reflection, and its derivative by the
    roughness; ``inv_o`` and ``inv_i`` as :func:`_ggx` gives them.
    """
    wide = r * r > _MIN_ALPHA
    alpha = r * r if wide else _MIN_ALPHA
    go, gi = _TWO * zo * inv_o, _TWO * zi * inv_i
    ratio = _ONE / max(go + gi - go * gi, _TINY)
    o_by_alpha = go * inv_o * alpha * (_ONE - zo * zo) / (_ONE / inv_o - zo)
    i_by_alpha = gi * inv_i * alpha * (_ONE - zi * zi) / (_ONE / inv_i - zi)
    by_alpha = ratio * ratio * (o_by_alpha * (_ONE - gi) + i_by_alpha * (_ONE - go))
    return ratio - _ONE, by_alpha * _TWO * r if wide else _ZERO


@inlined
def _cell(
    r: np.float32, c: np.float32, rows: int, columns: int
) -> tuple[int, np.float32, np.float32]:  # pragma: no cover - compiled
    """First entry of the cell that a roughness and a cosine lie in, and where in it, by rows and columns."""
    r, c = r if r > _ZERO else _ZERO, c if c > _ZERO else _ZERO  # NaN reads the first entry, none beyond the table
    row = (r if r < _ONE else _ONE) * np.float32(rows - 1)
    column = np.float32(math.sqrt(c if c < _ONE else _ONE)) * np.float32(columns - 1)
    low, left = min(int(row), rows - 2), min(int(column), columns - 2)
    return low * columns + left, row - np.float32(low), column - np.float32(left)


@inlined
def _entry(
    entries: FloatArray, first: int, columns: int, k: int, down: np.float32, right: np.float32
) -> np.float32:  # pragma: no cover - compiled
    """Bilinear value of number k in that cell."""
    above = entries[first, k] + right * (entries[first + 1, k] - entries[first, k])
    start = entries[first + columns, k]
    below = start + right * (entries[first + columns + 1, k] - start)
    value: np.float32 = above + down * (below - above)
    return value


@fastmath_kernel
def lobes_pdf(
    roughness: FloatArray, wo: FloatArray, wi: FloatArray, eta: np.float32, fraction: FloatArray, out: FloatArray
) -> None:  # pragma: no cover - compiled
    """Fill the rows of ``out`` [5, n] with d, s, pdf, dd/droughness and ds/droughness of a dielectric; ``fraction`` is
    that of the specular lobe, [n] or [1] for one of all lanes.
    """
    inv_eta2 = _ONE / (eta * eta)
    last = fraction.shape[0] - 1
    for i in range(wo.shape[0]):
        specular = fraction[min(i, last)]
        zo, zi, r = wo[i, 2], wi[i, 2], roughness[i, 0]
        front = (zo > _ZERO) & (zi > _ZERO)
        zo, zi = max(zo, _ZERO), max(zi, _ZERO)
        hx, hy, hz = wo[i, 0] + wi[i, 0], wo[i, 1] + wi[i, 1], max(zo + zi, _TINY)
        flat, up = hx * hx + hy * hy, hz * hz
        length = flat + up
        cos2 = _QUARTER * length
        cos = math.sqrt(cos2)

        density, inv_o, inv_i, log_by_roughness = _ggx(zo, zi, flat, up, r)
        cos_t = math.sqrt(max(_ONE - (_ONE - cos2) * inv_eta2, _ZERO))
        fs = (cos - eta * cos_t) / (cos + eta * cos_t)
        fp = (eta * cos - cos_t) / (eta * cos + cos_t)
        s = _HALF * (fs * fs + fp * fp) * density * zi * inv_o * inv_i

        mo, mi = max(_ONE - zo, _ZERO), max(_ONE - zi, _ZERO)
        mo2, mi2 = mo * mo, mi * mi
        fo, fi = mo2 * mo2 * mo, mi2 * mi2 * mi
        both = fo * fi
        retro_by_roughness = _TWO * cos2
        retro = retro_by_roughness * r
        lambert = zi * _INV_PI if front else _ZERO
        base = (_ONE - _HALF * fo) * (_ONE - _HALF * fi)
        out[0, i] = lambert * (base + retro * (fo + fi - both + retro * both))
        out[1, i] = s if front else _ZERO
        out[2, i] = (_ONE - specular) * lambert + _HALF * specular * density * inv_o if front else _ZERO
        out[3, i] = lambert * retro_by_roughness * (fo + fi - both + _TWO * retro * both)
        out[4, i] = s * log_by_roughness if front else _ZERO


@fastmath_kernel
def blend_lambert(
    roughness: FloatArray,
    wo: FloatArray,
    wi: FloatArray,
    part: np.float32,
    entries: FloatArray,
    rows: int,
    columns: int,
    out: FloatArray,
    by_part: FloatArray,
) -> None:  # pragma: no cover - compiled
    """Put a ``part`` of Lambert's lobe under a correlated coat into the rows d, s and their derivatives by the
    roughness that :func:`lobes_pdf` filled, and fill dd/dpart and ds/dpart [2, n], or [2, 0] for none; ``entries`` as
    in :func:`mean_lobes`, of Lambert's lobe.
    """
    wanted = by_part.shape[1] > 0
    for i in range(wo.shape[0]):
        zo, zi, r = wo[i, 2], wi[i, 2], roughness[i, 0]
        change_d, change_s = _ZERO, _ZERO
        if zo > _ZERO and zi > _ZERO:
            first, down, right = _cell(r, zo, rows, columns)
            lambert = zi * _INV_PI
            change_d = lambert * (_ONE - _entry(entries, first, columns, 1, down, right)) - out[0, i]
            out[3, i] -= part * (lambert * _entry(entries, first, columns, 3, down, right) + out[3, i])
            hx, hy, hz = wo[i, 0] + wi[i, 0], wo[i, 1] + wi[i, 1], max(zo + zi, _TINY)
            _, inv_o, inv_i, _ = _ggx(zo, zi, hx * hx + hy * hy, hz * hz, r)
            more, more_by_roughness = _correlated(zo, zi, r, inv_o, inv_i)
            change_s = out[1, i] * more
            out[4, i] += part * (out[4, i] * more + out[1, i] * more_by_roughness)
            out[0, i] += part * change_d
            out[1, i] += part * change_s
        if wanted:
            by_part[0, i], by_part[1, i] = change_d, change_s


@fastmath_kernel
def add_metal(
    roughness: FloatArray,
    metallic: FloatArray,
    wo: FloatArray,
    wi: FloatArray,
    part: np.float32,
    out: FloatArray,
    by_part: FloatArray,
    by_metallic: FloatArray,
) -> None:  # pragma: no cover - compiled
    """Blend metal by its part ``metallic`` [n, 1] into the rows that :func:`lobes_pdf` and :func:`blend_lambert` filled
    with ``part`` and ``by_part``, and fill dd/dmetallic and ds/dmetallic [2, n].
    """
    wanted = by_part.shape[1] > 0
    for i in range(wo.shape[0]):
        zo, zi, r, m = wo[i, 2], wi[i, 2], roughness[i, 0], metallic[i, 0]
        by_metallic[0, i], by_metallic[1, i] = -out[0, i], -out[1, i]
        change, grazing = _ZERO, _ZERO
        if zo > _ZERO and zi > _ZERO:
            hx, hy, hz = wo[i, 0] + wi[i, 0], wo[i, 1] + wi[i, 1], max(zo + zi, _TINY)
            flat, up = hx * hx + hy * hy, hz * hz
            density, inv_o, inv_i, log_by_roughness = _ggx(zo, zi, flat, up, r)
            g = density * zi * inv_o * inv_i
            g_by_roughness = g * log_by_roughness
            if wanted or part > _ZERO:
                more, more_by_roughness = _correlated(zo, zi, r, inv_o, inv_i)
                change = g * more
                g_by_roughness += part * (g_by_roughness * more + g * more_by_roughness)
                g += part * change
            past = max(_ONE - math.sqrt(_QUARTER * (flat + up)), _ZERO)
            past2 = past * past
            grazing = past2 * past2 * past
            by_metallic[0, i] += (_ONE - grazing) * g
            by_metallic[1, i] += grazing * g
            out[3, i] += m * ((_ONE - grazing) * g_by_roughness - out[3, i])
            out[4, i] += m * (grazing * g_by_roughness - out[4, i])
        out[0, i] += m * by_metallic[0, i]
        out[1, i] += m * by_metallic[1, i]
        if wanted:
            by_part[0, i] += m * ((_ONE - grazing) * change - by_part[0, i])
            by_part[1, i] += m * (grazing * change - by_part[1, i])


@fastmath_kernel
def direction(
    roughness: FloatArray, wo: FloatArray, u: FloatArray, fraction: FloatArray, out: FloatArray
) -> None:  # pragma: no cover - compiled
    """Fill ``out`` [n, 3] with directions drawn by the principled BSDF from the numbers ``u`` [n, 3]; ``fraction`` as
    in :func:`lobes_pdf`.
    """
    last = fraction.shape[0] - 1
    for i in range(wo.shape[0]):
        a, b = concentric_disk(u[i, 1], u[i, 2])
        if u[i, 0] < _ONE - fraction[min(i, last)]:
            out[i, 0], out[i, 1] = a, b
            out[i, 2] = math.sqrt(max(_ONE - a * a - b * b, _ZERO))
            continue

        x, y, z = wo[i, 0], wo[i, 1], wo[i, 2]
        alpha = max(roughness[i, 0] * roughness[i, 0], _MIN_ALPHA)
        scale = _ONE / math.sqrt(max(alpha * alpha * (x * x + y * y) + z * z, _TINY * _TINY))
        sx, sy, cos = alpha * x * scale, alpha * y * scale, z * scale
        sin = math.sqrt(sx * sx + sy * sy)
        cos_phi, sin_phi = (sx / sin, sy / sin) if sin > _TINY else (_ONE, _ZERO)
        chord = max(_ONE - a * a, _ZERO)
        edge = math.sqrt(chord)
        b = edge + _HALF * (_ONE + cos) * (b - edge)
        c = math.sqrt(max(chord - b * b, _ZERO))
        along = sin * c - cos * b
        mx, my = alpha * (cos_phi * along + sin_phi * a), alpha * (sin_phi * along - cos_phi * a)
        mz = max(sin * b + cos * c, _TINY)
        twice = _TWO * (x * mx + y * my + z * mz) / (mx * mx + my * my + mz * mz)
        out[i, 0], out[i, 1], out[i, 2] = twice * mx - x, twice * my - y, twice * mz - z


@kernel
def mean_lobes(
    roughness: FloatArray, cosine: FloatArray, entries: FloatArray, rows: int, columns: int, out: FloatArray
) -> None:  # pragma: no cover - compiled
    """Fill ``out`` [k, n] with bilinear values of a table ``entries`` [rows * columns, k] over roughness and the root
    of the cosine.
    """
    for i in range(roughness.shape[0]):
        first, down, right = _cell(roughness[i, 0], cosine[i], rows, columns)
        for k in range(out.shape[0]):
            out[k, i] = _entry(entries, first, columns, k, down, right)
