"""Which points of which cloud go into the merged one: per zone the better source first.

A client wants walls as the scanner saw them and roofs as the drone did, not both laid through each
other. A point is left out only where a better source has the same surface:

1. The two kinds of sensor are compared, never stations or flights of one kind. In each zone the
   better source is the one with less noise (standard deviation across fitted planes): that of the
   whole cloud, or the other one where both are flat in the zone and it proves clearly quieter.
2. A point of the worse source is left out where the better one is dense enough (a share of the
   worse one's density, counted over the 27 zones about it) and has its surface at the point:
   within the reach across the surface, within its own spacing along it.
3. Points that stand in for others are never left out themselves, so that no hole opens.

The reach follows from how far apart the two clouds lie where both are dense: noise and bending.
Everything is counted; `mode = "all"` brings every point back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from dougong.cloud import Cloud
from dougong.filters.neighbourhood import build_index, nearest
from dougong.params import Parameters
from dougong.pipeline.zones import Zones, grid_over, zones_of
from dougong.typing import Index, Kind, Mask, Points, Values

_QUIETER = 0.67
"""The noise of one source in a zone / that of the other, below which it is the better one there."""
_LOOK_M = 0.2
"""How far from a point the other source is looked for at all."""
_REACH_M = (0.03, 0.12)
_REACH_MEDIANS = 6.0
"""Reach / median distance of the clouds: four standard deviations of a normal distribution."""
_ALONG = 2.0
"""Distance along the surface / spacing of the better source, up to which it covers a point."""
_LEAST_ALONG_M = 0.02
REASON = "covered_by_better_source"


class Merge(Parameters):
    """The table ``[merge]``: what goes into the merged cloud."""

    mode: Literal["best", "all"] = "best"
    """best: where two kinds of sensor saw the same surface, only the better one; all: every
    point of every sure cloud."""
    zone_m: Annotated[float, Field(ge=0.05, le=5.0)] = 0.5
    """Edge of the zones in which density and noise are compared."""
    min_density_share: Annotated[float, Field(gt=0.0, le=10.0)] = 0.5
    """Density of the better source / that of the worse one, from which it may stand in for it."""
    reach_m: Annotated[float, Field(gt=0.0, le=1.0)] | None = None
    """How far across the surface the better source may lie; default: from the clouds, 3-12 cm."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """One cloud that may go into the merged one, in the frame of the reference."""

    cloud: Cloud
    source_id: int
    name: str
    kind: Kind


@dataclass(frozen=True, slots=True, kw_only=True)
class Merged:
    """What is kept of each part, and why the rest is not."""

    kept: tuple[Mask, ...]
    """One mask per part, over its points."""
    mode: Literal["best", "all"]
    noise_m: dict[str, float] = field(default_factory=dict)
    """Median noise of the flat zones, by kind."""
    reach_m: float | None = None
    note: str = ""

    def document(self, parts: Sequence[Part]) -> dict[str, Any]:
        """Return the books: what was kept and left out of each source."""
        rows: dict[str, dict[str, int]] = {}
        for part, kept in zip(parts, self.kept, strict=True):
            row = rows.setdefault(part.name, {"points": 0, "left_out": 0})
            row["points"] += int(kept.sum())
            row["left_out"] += int((~kept).sum())
        left_out = sum(row["left_out"] for row in rows.values())
        return {
            "mode": self.mode,
            "points": sum(row["points"] for row in rows.values()),
            "left_out": left_out,
            "left_out_reason": REASON if left_out else None,
            "sources": rows,
            "noise_m": self.noise_m,
            "reach_m": self.reach_m,
            "note": self.note,
        }


def choose(parts: Sequence[Part], params: Merge) -> Merged:
    """Return which points of each part go into the merged cloud.

    Deterministic; independent of the order of parts and points and of the thread count.
    """
    everything = tuple(np.ones(len(part.cloud), dtype=bool) for part in parts)
    if params.mode == "all":
        return Merged(kept=everything, mode="all")
    origin = parts[0].cloud.frame.origin
    groups: dict[Kind, list[int]] = {}
    for place, part in enumerate(parts):
        if len(part.cloud):
            groups.setdefault(part.kind, []).append(place)
    if len(groups) < 2:
        note = "one kind of sensor only: nothing to choose between"
        return Merged(kept=everything, mode="best", note=note)
    kinds = sorted(groups)
    sets = [
        np.concatenate([parts[place].cloud.rebased(origin).xyz for place in groups[kind]])
        for kind in kinds
    ]
    found = better_first(sets[0], sets[1], params)
    masks = list(everything)
    for kind, kept in zip(kinds, (found.kept_one, found.kept_other), strict=True):
        sizes = [len(parts[place].cloud) for place in groups[kind]]
        for place, mask in zip(groups[kind], np.split(kept, np.cumsum(sizes)[:-1]), strict=True):
            masks[place] = mask
    return Merged(
        kept=tuple(masks),
        mode="best",
        noise_m=dict(zip(kinds, found.noise_m, strict=True)),
        reach_m=found.reach_m,
        note=found.note,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Chosen:
    """What is kept of two point sets."""

    kept_one: Mask
    kept_other: Mask
    noise_m: tuple[float, float]
    reach_m: float | None
    note: str = ""


def better_first(one: Points, other: Points, params: Merge) -> Chosen:
    """Return which points of two sensors' sets stay; (n, 3) and (m, 3), metres, one frame."""
    grid = grid_over([one, other], params.zone_m)
    zones = [zones_of(one, grid), zones_of(other, grid)]
    noise = (zones[0].typical_noise_m, zones[1].typical_noise_m)
    if not np.isfinite(noise).all():
        return Chosen(
            kept_one=np.ones(len(one), dtype=bool),
            kept_other=np.ones(len(other), dtype=bool),
            noise_m=noise,
            reach_m=None,
            note="a cloud has no flat zone to judge its noise by: every point was kept",
        )
    good, bad = (0, 1) if noise[0] <= noise[1] else (1, 0)
    points = [one, other]
    better, worse = _Side(points[good], zones[good]), _Side(points[bad], zones[bad])
    is_reversed = _reversed_zones(better.zones, worse.zones)
    reach = params.reach_m or _reach(better, worse, params)
    # Where the worse cloud is the better one, its points stay and stand in for the other's.
    stands_in = worse.in_zones(is_reversed)
    lost_better = np.zeros(len(better.points), dtype=bool)
    if stands_in.any():
        candidates = np.flatnonzero(better.in_zones(is_reversed))
        lost_better[candidates] = _covered(
            better.points[candidates], better.zones, worse.only(stands_in), reach, params
        )
    candidates = np.flatnonzero(~stands_in)
    lost_worse = np.zeros(len(worse.points), dtype=bool)
    lost_worse[candidates] = _covered(
        worse.points[candidates], worse.zones, better.only(~lost_better), reach, params
    )
    kept = [~lost_better, ~lost_worse]
    return Chosen(
        kept_one=kept[0] if good == 0 else kept[1],
        kept_other=kept[1] if good == 0 else kept[0],
        noise_m=noise,
        reach_m=reach,
    )


@dataclass(frozen=True, slots=True)
class _Side:
    """The points of one source and their zones."""

    points: Points
    zones: Zones
    place: Index | None = None
    """(n,) zone of each point, where the points are some of those that made the zones."""

    def of(self) -> Index:
        return self.zones.place if self.place is None else self.place

    def only(self, chosen: Mask) -> _Side:
        return _Side(self.points[chosen], self.zones, self.of()[chosen])

    def in_zones(self, keys: Index) -> Mask:
        """Return which points lie in zones of these sorted keys."""
        return np.isin(self.zones.keys[self.of()], keys)


def _reversed_zones(better: Zones, worse: Zones) -> Index:
    """Return the keys of zones in which the noisier cloud is clearly the quieter one."""
    at, is_there = worse.find(better.keys)
    with np.errstate(invalid="ignore"):
        is_quieter = worse.noise_m[at] < _QUIETER * better.noise_m
    return better.keys[is_there & is_quieter]


def _reach(better: _Side, worse: _Side, params: Merge) -> float:
    """Return how far across the surface the two clouds lie from each other, with noise."""
    dense = _is_dense(worse.points, worse.zones, better.zones, params)
    asked = worse.points[dense]
    place, distance = nearest(build_index(better.points), asked, _LOOK_M)
    hit = np.flatnonzero(place >= 0)
    zone = better.of()[place[hit]]
    gap = asked[hit] - better.points[place[hit]]
    is_over = _is_over(gap, distance[hit], better.zones, zone)
    is_flat = is_over & np.isfinite(better.zones.noise_m[zone])
    across = np.abs(np.einsum("ij,ij->i", gap, better.zones.normals[zone]))[is_flat]
    if not len(across):
        return _REACH_M[0]
    return float(np.clip(_REACH_MEDIANS * np.median(across), *_REACH_M))


def _is_dense(points: Points, own: Zones, other: Zones, params: Merge) -> Mask:
    """Return where the `other` source has its share of the density about each of `points`."""
    keys, place = np.unique(own.grid.keys(own.grid.cells(points)), return_inverse=True)
    is_dense: Mask = other.around(keys) >= params.min_density_share * own.around(keys)
    return is_dense[place]


def _covered(points: Points, own: Zones, by: _Side, reach: float, params: Merge) -> Mask:
    """Return which `points` the source `by` can stand in for; `own`: the zones they are from."""
    is_covered = np.zeros(len(points), dtype=bool)
    if not len(points) or not len(by.points):
        return is_covered
    dense = np.flatnonzero(_is_dense(points, own, by.zones, params))
    place, distance = nearest(build_index(by.points), points[dense], reach)
    hit = np.flatnonzero(place >= 0)
    zone = by.of()[place[hit]]
    gap = points[dense[hit]] - by.points[place[hit]]
    is_covered[dense[hit]] = _is_over(gap, distance[hit], by.zones, zone)
    return is_covered


def _is_over(gap: Points, distance: Values, zones: Zones, zone: Index) -> Mask:
    """Return which gaps (k, 3) lead across the surface of a zone rather than along it.

    Where the zone is not flat the direction means nothing, and the distance alone decides.
    """
    normal = zones.normals[zone]
    across = np.einsum("ij,ij->i", gap, normal)
    along = np.sqrt(np.clip(distance**2 - across**2, 0.0, None))
    spacing = zones.grid.edge_m / np.sqrt(zones.counts[zone])
    is_flat = np.isfinite(zones.noise_m[zone])
    is_over: Mask = ~is_flat | (along <= np.maximum(_ALONG * spacing, _LEAST_ALONG_M))
    return is_over
