"""Which points lie inside polygons in plan."""

from dougong.kernels._arrays import Flags, Floats, Ints
from dougong.kernels._jit import kernel


@kernel
def inside_rings(
    points: Floats, corners: Floats, ring_starts: Ints, start: int, stop: int, out: Flags
) -> None:
    """Fill out[start:stop]: does a ray along +x from the point cross an odd number of edges.

    points (n, 3); corners (m, 2) of all rings one after another; ring_starts (rings + 1,). A ring
    inside another is a hole. Edges are closed below and open above, so of two areas that share an
    edge a point on it belongs to exactly one.
    """
    for i in range(start, stop):
        x, y = points[i, 0], points[i, 1]
        is_inside = False
        for ring in range(ring_starts.shape[0] - 1):
            before = ring_starts[ring + 1] - 1
            for corner in range(ring_starts[ring], ring_starts[ring + 1]):
                ax, ay = corners[before, 0], corners[before, 1]
                bx, by = corners[corner, 0], corners[corner, 1]
                if (ay > y) != (by > y):
                    # The lower end first: both areas at an edge work out the same crossing.
                    if ay > by:
                        ax, ay, bx, by = bx, by, ax, ay
                    if x < ax + (y - ay) / (by - ay) * (bx - ax):
                        is_inside = not is_inside
                before = corner
        out[i] = is_inside
