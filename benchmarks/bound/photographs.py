"""What training photographs are to a recovery: their noise, and how their pixels answer to the materials."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from neurad.core.colour import luminance
from neurad.core.protocols import Materials
from neurad.core.records import FloatArray, PixelBatch, Surface
from neurad.core.rng import Stream
from neurad.integrators.estimator import Estimator
from neurad.integrators.film import box_mean
from neurad.integrators.primary_hits import PrimaryHits

DARK = 0.05
"""Added to the albedo that a photograph is divided by: what a black surface still reflects."""
MIN_NOISE, MAX_NOISE = 0.003, 1.0
"""Standard deviations that are taken for a pixel's noise, as fractions of its radiance."""
TAIL = 30.0
"""Standard deviations at which differences of neighbouring pixels are cut off: fireflies are no part of them."""
MIN_SCALE, MIN_SHARE = 0.1, 1e-3
"""Least variance that is left of the noise, and least of any sum of channels over the largest."""
_CHUNK = 1 << 15  # pixels


def photo_noise(photograph: FloatArray, albedo: FloatArray) -> FloatArray:
    """Standard deviation of a photograph's own noise [h, w, 3], from how neighbouring pixels differ.

    Light on a surface changes slowly: once a photograph is divided by the true albedo, second differences are noise,
    save at edges. Their median over 5 x 5 pixels, both ways, is little moved by edges and by single outliers, and noise
    is not the same everywhere. A pattern of single pixels that the albedo does not explain is taken for noise, too:
    :func:`noise_covariance` corrects for it.

    Args:
        photograph: linear radiance [h, w, 3].
        albedo: true albedo of its pixels [h, w, 3].
    """
    light = luminance(torch.from_numpy(photograph).clamp_min(0.0) / (torch.from_numpy(albedo) + DARK))  # [h, w]
    around = torch.nn.functional.pad(light[None], (1, 1, 1, 1), mode="reflect")[0]
    across = (2 * light - around[1:-1, :-2] - around[1:-1, 2:]).abs()
    along = (2 * light - around[:-2, 1:-1] - around[2:, 1:-1]).abs()
    padded = torch.nn.functional.pad(torch.stack((across, along)), (2, 2, 2, 2), mode="reflect")
    windows = padded.unfold(1, 5, 1).unfold(2, 5, 1).permute(1, 2, 0, 3, 4).flatten(2)  # [h, w, 50]
    deviation = windows.median(-1).values / (0.6745 * math.sqrt(6.0))  # of normal noise, by its second differences
    relative = (deviation / light.clamp_min(1e-12)).clamp(MIN_NOISE, MAX_NOISE).unsqueeze(-1).numpy()
    sigma: FloatArray = (relative * np.maximum(photograph, 0.0) + 1e-6).astype(np.float32)
    return sigma


def noise_covariance(photographs: FloatArray, predicted: Predicted, sigma: FloatArray, known: FloatArray) -> FloatArray:
    """Covariance of channels' noise in units of :func:`photo_noise` [3, 3]: what two predictions with noise of their
    own agree that neighbouring pixels of the photographs differ by. On its diagonal, the same in all channels, it is at
    most 1. Off the diagonal is how much of the noise channels share: that of path-traced light nearly all.

    Args:
        photographs: [views, h, w, 3].
        predicted: of the same pixels.
        sigma: from :func:`photo_noise` [views, h, w, 3]; 0 in pixels that do not count.
        known: covariance of each pixel's channels that is not the photographs' noise but has the same differences
            [views, h, w, 3, 3].
    """
    used = ((sigma[:, :, 1:] > 0) & (sigma[:, :, :-1] > 0)).all(-1)
    mean = ((sigma[:, :, 1:] + sigma[:, :, :-1]) / 2)[used]  # [n, 3]
    differences = []
    for picture in predicted.pictures.reshape(2, *photographs.shape):
        residual = photographs - picture
        difference = (residual[:, :, 1:] - residual[:, :, :-1])[used] / mean
        differences.append(np.clip(difference, -TAIL, TAIL).astype(np.float64))
    other = ((known[:, :, 1:] + known[:, :, :-1]) / 2)[used] / (mean[:, :, None] * mean[:, None, :])
    found = differences[0].T @ differences[1] / (2 * max(len(mean), 1)) - other.mean(0, dtype=np.float64)
    # A scale, and what channels have in common.
    scale = float(np.clip(np.trace(found) / 3, MIN_SCALE, 1.0))
    power, axes = np.linalg.eigh((found + found.T) / 2)
    shared = (axes * power.clip(MIN_SHARE * max(power.max(), 1e-12))) @ axes.T
    deviation = np.sqrt(np.diag(shared))
    covariance: FloatArray = (scale * shared / np.outer(deviation, deviation)).astype(np.float32)
    return covariance


@dataclass(frozen=True)
class Predicted:
    """Photographs as a light field predicts them for true materials."""

    pictures: FloatArray
    """Two independent estimates [2, views, pixels, 3]."""
    by_albedo: FloatArray
    """Derivative of each channel by its albedo [views, pixels, 3]."""
    by_roughness: FloatArray
    """By the roughness [views, pixels, 3]; 0 where it does not stand out of the noise."""


def predict(
    estimator: Estimator, truth: Materials, primary: PrimaryHits, left_out: Tensor, spp: int, seed: int, width: int
) -> Predicted:
    """Render the training views' surfaces with true materials in the light that ``estimator`` knows.

    Args:
        estimator: its materials and radiance field make the light that arrives; the vertex itself has true materials.
        truth: true materials.
        primary: camera rays of the training views.
        left_out: pixels that do not count [views, pixels], bool; they stay 0.
        spp: samples a pixel, at least 2.
        seed: of the noise.
        width: of the views in pixels.
    """
    views, pixels = left_out.shape
    device = primary.prim.device
    pictures = np.zeros((2, views, pixels, 3), np.float32)
    answers = np.zeros((2, views, pixels, 6), np.float32)
    for view in range(views):
        kept = (~left_out[view]).nonzero().squeeze(-1)
        for part in torch.split(kept, _CHUNK):
            black, whole = torch.zeros(len(part), 3, device=device), torch.ones(len(part), device=device)
            batch = PixelBatch(torch.full_like(part, view), part, black, whole, 0)
            for half in range(2):
                stream = Stream(seed, view, int(part[0]), half, device=device)
                found = _respond(estimator, truth, primary, batch, max(1, spp // 2), stream)
                pictures[half, view, part.cpu().numpy()] = found[:, :3]
                answers[half, view, part.cpu().numpy()] = found[:, 3:]
    by_albedo, by_roughness = np.zeros((2, views, pixels, 3), np.float32)
    for view in range(views):
        halves = answers[:, view].reshape(2, -1, width, 6)
        counted = (~left_out[view]).cpu().numpy().reshape(-1, width)
        by_albedo[view] = _smooth(halves[..., :3].mean(0), counted, 3).reshape(-1, 3)
        by_roughness[view] = _significant(halves[..., 3:], counted).reshape(-1, 3)
    return Predicted(pictures, by_albedo, by_roughness)


def _respond(
    estimator: Estimator, truth: Materials, primary: PrimaryHits, batch: PixelBatch, spp: int, stream: Stream
) -> FloatArray:
    """Radiance, its derivatives by albedo and by roughness, one column a channel, means of pixels [b, 9]."""
    si = primary(batch, spp, stream).si
    there = truth(si)
    surface = Surface(there.albedo.requires_grad_(), there.roughness.requires_grad_(), there.model)
    value = estimator.image(si, surface, 1, stream, spp).value  # [b * spp, 3]
    (by_albedo,) = torch.autograd.grad(value.sum(), surface.albedo, retain_graph=True, allow_unused=True)
    by_roughness = [
        torch.autograd.grad(value[:, c].sum(), surface.roughness, retain_graph=c < 2, allow_unused=True)[0]
        for c in range(3)
    ]
    columns = [value.detach(), torch.zeros_like(value) if by_albedo is None else by_albedo]
    columns += [torch.zeros_like(value[:, :1]) if x is None else x for x in by_roughness]
    means: FloatArray = torch.cat(columns, -1).view(-1, spp, 9).mean(1).cpu().numpy()
    return means


def _smooth(image: FloatArray, counted: np.ndarray, size: int) -> FloatArray:
    """Box means over the pixels that count [h, w, c]; 0 elsewhere."""
    inside = counted[..., None].astype(np.float32)
    means = [box_mean(torch.from_numpy(x), size).numpy() for x in (image * inside, inside)]
    result: FloatArray = (inside * means[0] / np.maximum(means[1], 1e-12)).astype(np.float32)
    return result


def _significant(halves: FloatArray, counted: np.ndarray) -> FloatArray:
    """What two independent estimates [2, h, w, 3] agree on: their mean after a 5 x 5 mean, times the fraction of its
    power that they have in common around each pixel. Noise would else count as knowledge of the roughness.
    """
    first, second = (_smooth(half, counted, 5) for half in halves)
    mean = (first + second) / 2
    common = _smooth((first * second).mean(-1, keepdims=True), counted, 9)
    power = _smooth((mean**2).mean(-1, keepdims=True), counted, 9)
    return (mean * np.clip(common / np.maximum(power, 1e-20), 0.0, 1.0)).astype(np.float32)
