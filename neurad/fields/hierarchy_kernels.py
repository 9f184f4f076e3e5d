"""The kernel of :class:`neurad.fields.hierarchy.Hierarchy`: sums of the effects that points read."""

from typing import Any

from neurad.runtime.jit import kernel


@kernel
def means(
    x: Any, color: Any, part: Any, mesh: Any, effects: Any, index: int, keys: Any, values: Any, node: Any, out: Any
) -> None:  # pragma: no cover - compiled
    """Add all effects to values; points beside each other mostly lie in one cell, which is looked up once.

    Args:
        x: positions in the unit cube [n, 3].
        color: cube roots of the albedo [n, 3].
        part: connected parts [n]; ``mesh`` likewise.
        effects: of each whether it reads positions (1), colours (2) or nothing (0), its cells, whether each part (1) or
            mesh (2) has its own, and where its coefficients begin and end [e, 5].
        index: keys of one effect lie so far from those of the next.
        keys: of all coefficients, ascending [k].
        values: theirs [k].
        node: room for eight numbers.
        out: the sums; added to [n].
    """
    for e in range(len(effects)):
        reads, cells, owner, begin, end = effects[e]
        side = cells + 1
        before = -1
        for i in range(len(out)):
            first = e * index
            if owner > 0:
                first += (part[i] if owner == 1 else mesh[i]) * side * side * side
            fx, fy, fz = 0.0, 0.0, 0.0
            if reads > 0:
                at = x[i] if reads == 1 else color[i]
                sx, sy, sz = (
                    min(max(at[0], 0.0), 1.0) * cells,
                    min(max(at[1], 0.0), 1.0) * cells,
                    min(max(at[2], 0.0), 1.0) * cells,
                )
                cx, cy, cz = min(int(sx), cells - 1), min(int(sy), cells - 1), min(int(sz), cells - 1)
                fx, fy, fz = sx - cx, sy - cy, sz - cz
                first += (cx * side + cy) * side + cz
            if first != before:
                before = first
                low = begin
                for row in range(4 if reads > 0 else 1):  # of two nodes, beside each other along the last axis
                    key = first + ((row >> 1) * side + (row & 1)) * side
                    high = end if row == 0 or (low < end and keys[low] < key) else low
                    while low < high:
                        middle = (low + high) // 2
                        if keys[middle] < key:
                            low = middle + 1
                        else:
                            high = middle
                    node[2 * row] = node[2 * row + 1] = -1
                    if low < end and keys[low] == key:
                        node[2 * row] = low
                        low += 1
                    if low < end and keys[low] == key + 1:
                        node[2 * row + 1] = low
            if reads == 0:
                if node[0] >= 0:
                    out[i] += values[node[0]]
                continue
            for corner in range(8):
                k = node[corner]
                if k >= 0:
                    weight = (fx if corner & 4 else 1.0 - fx) * (fy if corner & 2 else 1.0 - fy)
                    out[i] += weight * (fz if corner & 1 else 1.0 - fz) * values[k]
