"""The search behind `clutter`: wires first, then clusters of the rest, described one by one.

Kernels are imported when called.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dougong._sorting import by_coordinates
from dougong.filters import wires
from dougong.filters.clusters import (
    Clusters,
    clusters_of,
    distance_to,
    eighth_nearest,
    members,
    spacing_of,
)
from dougong.filters.clutter_kinds import Clutter, ClutterKind, kind_of
from dougong.filters.clutter_shapes import shape_of
from dougong.filters.neighbourhood import Neighbourhood, build_index, nearest
from dougong.typing import Index, Points, Values

STRUCTURE_M = 3.0
"""A pole must stand clear of clusters longer than this."""
LINES_HALO_M = wires.BALL_M
"""How far `count_lines` reaches, beside `gap_most_m`."""
GAP_SPACINGS = 5.0
"""Points of a cluster are at most so many spacings from one another."""


class Whole(NamedTuple):
    """What the search must know of a cloud to look at a part of it, its halo included."""

    own: int
    """The first so many points are the part's own."""
    has_rows: bool
    """Whether thin lines are the scanner's rows (`wires.are_rows` of the whole cloud)."""


class Found(NamedTuple):
    """What was found among n points, in the caller's order."""

    kind: NDArray[np.uint8]
    margin: Values
    counts: dict[str, int]
    """Own clusters and points by kind: ``person_clusters``, ``person_points`` ..."""
    has_rows: bool = False
    """Wires were not looked for: the scanner's rows would be taken for them."""


@dataclass(frozen=True, slots=True)
class _Site:
    """The points that clusters are made of; everything in the order of the index."""

    index: Neighbourhood
    place: Index
    """(m,) place of each point in the caller's array."""
    clusters: Clusters
    low: dict[int, Index]
    """By the root of a cluster: places in the caller's array of the low points beside it."""


def halo_m(params: Clutter) -> float:
    """Return how far the search reaches: a cluster, what it stands clear of, and wires between."""
    gaps = 3.0 * params.gap_most_m
    return params.largest_m + params.pole_clear_m + STRUCTURE_M + gaps + wires.halo_m()


def nothing(points: int) -> Found:
    """Return that nothing was found among so many points."""
    return Found(np.zeros(points, np.uint8), np.zeros(points), {})


@dataclass(frozen=True, slots=True)
class _Upper:
    """The points that do not lie near the ground, in the order of an index."""

    index: Neighbourhood
    place: Index
    """(m,) place of each in the caller's array."""
    eighth_m: Values
    lines: wires.Lines


def _upper(xyz: Points, height: Values, p: Clutter) -> _Upper:
    up = np.flatnonzero(~(height < p.foot_m))
    index = build_index(xyz[up])
    place = up[index.order]
    eighth = eighth_nearest(index, p.gap_most_m)
    lines = wires.thin_lines(index, height[place], eighth, p.wire_height_m)
    return _Upper(index, place, eighth, lines)


def count_lines(xyz: Points, height: Values, p: Clutter, own: int) -> tuple[int, int]:
    """Return how many of the first `own` points are high, and how many of these on thin lines."""
    upper = _upper(xyz, height, p)
    return upper.lines.counts(upper.place < own)


def search(xyz: Points, height: Values, p: Clutter, whole: Whole | None = None) -> Found:
    """Look for clutter among points (n, 3) of `height` (n,): a cloud, or the part of a `whole`."""
    kind, margin, counts, _ = nothing(len(xyz))
    upper = _upper(xyz, height, p)
    place = upper.place
    if whole is None:
        every = np.ones(len(place), bool)
        whole = Whole(len(xyz), wires.are_rows(*upper.lines.counts(every)))
    own = whole.own
    is_wire = np.zeros(len(place), bool)
    if not whole.has_rows:
        run = wires.runs_of_wires(upper.index, upper.lines)
        is_wire = run >= p.wire_length_m
    if "wire" in p.kinds and is_wire.any():
        along = (run[is_wire] - p.wire_length_m) / p.wire_length_m
        chosen = place[is_wire][along >= p.min_margin]
        kind[chosen], margin[chosen] = ClutterKind.WIRE, along[along >= p.min_margin]
    low = np.flatnonzero(height < p.foot_m)
    site = _site(xyz, place[~is_wire], upper.eighth_m[~is_wire], low, p)
    for places, found, share in _offered(site, xyz, height, p, own):
        kind[places], margin[places] = found, share
        # A cluster that several parts of a cloud see belongs to one: that of its first point.
        _count(counts, f"{found.name.lower()}_clusters", int(places[0] < own))
    for found in ClutterKind:
        if found != ClutterKind.NONE:
            points = int(np.count_nonzero(kind[:own] == found))
            _count(counts, f"{found.name.lower()}_points", points)
    return Found(kind, margin, counts, whole.has_rows)


def _count(counts: dict[str, int], name: str, more: int) -> None:
    if more:
        counts[name] = counts.get(name, 0) + more


def _site(xyz: Points, place: Index, eighth: Values, low: Index, p: Clutter) -> _Site:
    """Cluster the points at `place`, and give each cluster the low points beside it."""
    index = build_index(xyz[place])
    gap = np.clip(GAP_SPACINGS * spacing_of(eighth[index.order]), p.gap_least_m, p.gap_most_m)
    clusters = clusters_of(index, gap, p.gap_least_m)
    return _Site(index, place[index.order], clusters, _beside(index, clusters, xyz, low, p))


def _beside(
    index: Neighbourhood, clusters: Clusters, xyz: Points, low: Index, p: Clutter
) -> dict[int, Index]:
    """Return the `low` points beside each cluster, by its root: near enough to one of it."""
    at, _ = nearest(index, xyz[low], p.gap_least_m)
    low, at = low[at >= 0], at[at >= 0]
    if not len(low):
        return {}
    sorted_place = index.unsorted(np.arange(len(index.order)))
    root = clusters.root[sorted_place[at]]
    order = np.argsort(root, kind="stable")
    roots, starts = np.unique(root[order], return_index=True)
    return dict(zip(roots.tolist(), np.split(low[order], starts[1:]), strict=True))


def _offered(
    site: _Site, xyz: Points, height: Values, p: Clutter, own: int
) -> list[tuple[Index, ClutterKind, float]]:
    """Return the clusters with own points that are clutter: places, kind and margin of each."""
    clusters = site.clusters
    is_small = (clusters.held >= p.min_points) & (clusters.longest_m <= p.largest_m)
    has_own = np.zeros(len(clusters.root), bool)
    has_own[clusters.root[site.place < own]] = True
    for beside, places in site.low.items():
        has_own[beside] |= (places < own).any()
    roots = np.flatnonzero(is_small & has_own)
    offered: list[tuple[Index, ClutterKind, float]] = []
    for root, members_of in zip(roots, members(clusters, roots), strict=True):
        low = site.low.get(int(root), np.empty(0, np.int64))
        places = _by_content(xyz, np.concatenate([site.place[members_of], low]))
        if np.isnan(height[places]).any():
            continue
        kind, margin = kind_of(shape_of(xyz[places], height[places]), p)
        if kind == ClutterKind.POLE and not _stands_clear(site, members_of, p.pole_clear_m):
            continue
        if kind != ClutterKind.NONE:
            offered.append((places, kind, margin))
    return offered


def _by_content(xyz: Points, places: Index) -> Index:
    """Return `places` sorted by x, y, z: the same points wherever they come from."""
    ordered: Index = places[by_coordinates(xyz[places])]
    return ordered


def _stands_clear(site: _Site, members_of: Index, clear_m: float) -> bool:
    """Say whether no other cluster longer than `STRUCTURE_M` comes within `clear_m` of one."""
    if clear_m == 0.0:
        return True
    own = site.clusters.root[members_of[0]]
    is_large = site.clusters.longest_m[site.clusters.root] > STRUCTURE_M
    chosen = is_large & (site.clusters.root != own)
    return bool(
        distance_to(site.index, chosen, site.index.points[members_of], clear_m).min() >= clear_m
    )
