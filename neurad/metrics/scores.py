"""Scores of maps against their truth, pooled over pixels of several views."""

import math

import numpy as np

from neurad.core.records import BoolArray, Float64Array, FloatArray

MAPE_OFFSET = 0.01
"""Added to the truth below the fraction, so that black does not decide alone."""


def psnr(mse: float) -> float:
    """Peak signal-to-noise ratio in dB of a mean squared error, for a peak of 1; infinite without error."""
    return math.inf if mse == 0 else -10.0 * math.log10(mse)


def block_means(values: FloatArray, mask: BoolArray, size: int) -> tuple[FloatArray, Float64Array]:
    """Means of ``values`` [h, w, c] over blocks of ``size`` x ``size`` pixels, of the pixels in ``mask`` [h, w] alone.

    Returns:
        Means [rows, columns, c], 0 where the block has no pixel in the mask, and how many it has [rows, columns];
        blocks at the right and lower edge may be smaller.
    """
    h, w = mask.shape
    pad = ((0, -h % size), (0, -w % size))
    weight = np.pad(mask, pad).astype(np.float64)
    # where, not a product: pixels outside the mask may be anything
    summed = np.pad(np.where(mask[..., None], values, 0.0).astype(np.float64), (*pad, (0, 0)))
    rows, columns = weight.shape[0] // size, weight.shape[1] // size
    count = weight.reshape(rows, size, columns, size).sum((1, 3))
    total = summed.reshape(rows, size, columns, size, -1).sum((1, 3))
    return (total / np.maximum(count, 1.0)[..., None]).astype(np.float32), count


def _ratio(a: Float64Array, b: Float64Array) -> Float64Array:
    """``a / b``, 1 where ``b`` is 0."""
    return np.divide(a, b, out=np.ones_like(a), where=b > 0)


class Pool:
    """Pixels of one kind from all views: errors are averaged over all of them before any logarithm is taken."""

    def __init__(self) -> None:
        self._parts: list[tuple[FloatArray, FloatArray, Float64Array]] = []

    def add(
        self,
        predicted: FloatArray,
        truth: FloatArray,
        mask: BoolArray | None = None,
        weight: Float64Array | None = None,
    ) -> None:
        """Add pixels [..., c]: those in ``mask`` [...], or all; each counts ``weight`` [...] times, or once."""
        if predicted.shape != truth.shape:
            raise ValueError(f"shapes of prediction and truth differ: {predicted.shape} and {truth.shape}")
        shape = truth.shape[:-1]
        mask = np.ones(shape, np.bool_) if mask is None else mask
        weight = np.ones(shape) if weight is None else weight
        self._parts.append((predicted[mask], truth[mask], weight[mask]))

    def __len__(self) -> int:
        return sum(len(weight) for *_, weight in self._parts)

    def _joined(self) -> tuple[Float64Array, Float64Array, Float64Array]:
        """Prediction and truth [p, c] and weights [p] of sum 1."""
        predicted, truth, weight = (np.concatenate(x).astype(np.float64) for x in zip(*self._parts, strict=True))
        return predicted, truth, weight / weight.sum()

    def factors(self) -> dict[str, Float64Array]:
        """What the prediction is to be multiplied by to fit the truth best in the least-squares sense [c]: ``scaled1``
        by one number, ``scaled3`` by one for each channel; 1 where the prediction is black. Empty without pixels.
        """
        if len(self) == 0:
            return {}
        predicted, truth, weight = self._joined()
        product, square = weight @ (predicted * truth), weight @ np.square(predicted)
        return {"scaled1": _ratio(product.sum(keepdims=True), square.sum(keepdims=True)).repeat(len(product)),
                "scaled3": _ratio(product, square)}  # fmt: skip

    def scores(self, scaled: bool = False) -> dict[str, float]:
        """``psnr`` and ``mape`` of the prediction, and ``psnr_constant`` and ``mape_constant`` of the best constant,
        the mean of the truth over the same pixels, one value a channel. Empty without pixels.

        With ``scaled`` also ``psnr_scaled1``, ``mape_scaled1`` and the same with ``scaled3``, after :meth:`factors`.
        """
        if len(self) == 0:
            return {}
        predicted, truth, weight = self._joined()
        guesses = {"": predicted, "_constant": np.broadcast_to(weight @ truth, truth.shape)}
        if scaled:
            guesses |= {f"_{name}": predicted * factor for name, factor in self.factors().items()}
        result = {}
        for suffix, guess in guesses.items():
            error = guess - truth
            result[f"psnr{suffix}"] = psnr(float(weight @ np.square(error).mean(-1)))
            result[f"mape{suffix}"] = float(weight @ (np.abs(error) / (truth + MAPE_OFFSET)).mean(-1))
        return result
