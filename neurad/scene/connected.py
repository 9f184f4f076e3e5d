"""Which triangles of a mesh, or other things, are connected."""

import numpy as np

from neurad.core.records import Float64Array, FloatArray, IntArray


def connected_parts(vertices: FloatArray, faces: IntArray) -> IntArray:
    """Which connected part each triangle belongs to [f], counted from 0 as they come. Vertices at the same place are
    the same, since files split them where normals or texture coordinates jump.
    """
    corner = welded_corners(vertices, faces)
    label = joined_places(corner)
    _, first, number = np.unique(label[corner[:, 0]], return_index=True, return_inverse=True)
    order: IntArray = np.argsort(np.argsort(first))[number.reshape(-1)]
    return order


def welded_corners(vertices: FloatArray | Float64Array, faces: IntArray) -> IntArray:
    """Numbers of the places where the corners of triangles lie [f, 3]; as of :func:`connected_parts`."""
    _, same = np.unique(vertices, axis=0, return_inverse=True)
    corner: IntArray = same.reshape(-1)[faces]
    return corner


def joined_places(corner: IntArray) -> IntArray:
    """For each place the connected part that it is of, by the numbers of the triangles' corners [f, 3]."""
    begin, end = np.concatenate((corner[:, :2], corner[:, 1:])).T
    return linked(begin, end, int(corner.max(initial=-1)) + 1)


def linked(one: IntArray, other: IntArray, count: int) -> IntArray:
    """Which group each of ``count`` things is of, where those of ``one`` [n] are linked to those of ``other`` [n]."""
    from scipy.sparse import coo_matrix  # imported where it is needed: it loads slowly
    from scipy.sparse.csgraph import connected_components

    links = coo_matrix((np.ones(len(one), np.int8), (one, other)), (count, count))
    return np.asarray(connected_components(links, directed=False)[1], np.int64)
