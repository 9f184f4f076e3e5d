"""Made-up pixels of a surface with highlights, whose roughness is off by a known amount."""

import numpy as np

from neurad.evidence.pixel_means import PixelMeans

SIDE, VIEWS = 48, 6
CHANGE, PATCHES = 0.08, 128


def means(change=CHANGE, noise=0.25, steady=False, derivatives=True, grey=0.0, sheen=(1.0, 1.0, 1.0), seed=0):
    """Views of a square of a patch and more, seen with highlights at different places; the roughness is ``change``
    more than what was taken for it, the albedo of each patch another by chance. Of the photographs' noise a part is
    the same in all channels (``grey``), of the derivatives by roughness what ``sheen`` says is in each of them.
    """
    rng = np.random.default_rng(seed)
    row, column = np.divmod(np.arange(SIDE * SIDE), SIDE)
    p = np.stack((0.3 + 0.2 * column / SIDE, 0.3 + 0.2 * row / SIDE, np.full(SIDE * SIDE, 0.5001)), -1)
    patch = (p * PATCHES).astype(int)
    albedo = np.random.default_rng(7).normal(0.0, 0.05, (PATCHES, PATCHES, 3))[patch[:, 0], patch[:, 1]]
    parts = []
    for view in range(VIEWS):
        d = 1.0 + 0.3 * np.sin(column / 9.0 + view)[:, None] * np.ones(3)
        centre = 0.0 if steady else 12.0 * np.cos(2.0 * view)
        r = 0.8 * np.exp(-((column - SIDE / 2 - centre) ** 2 + (row - SIDE / 2 + centre) ** 2) / 150.0)[:, None]
        r = (0.4 * d if steady else r * np.array(sheen)) * derivatives
        photograph = r * change + d * albedo + grey * rng.standard_normal((len(p), 1))
        r, d, e = (
            value + size * rng.standard_normal(d.shape) for value, size in ((r, noise), (d, 0.1), (photograph, 0.15))
        )
        corner = np.stack((column, row), -1)
        prim = np.zeros(len(p), np.int64)
        parts.append(
            [np.full(len(p), view), corner, p.astype(np.float32), prim, *(x.astype(np.float32) for x in (r, d, e))]
        )
    return PixelMeans(*(np.concatenate(column) for column in zip(*parts, strict=True)))
