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
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from dougong._sorting import grouped
from dougong.cloud import Frame, Pieces
from dougong.filters.neighbourhood import build_index, nearest
from dougong.formats.model import Hold
from dougong.params import Parameters
from dougong.pipeline.left_out import LeftOut, Remaining
from dougong.pipeline.sides import HALO_SHARE, Tiles, cut, whole
from dougong.pipeline.zones import Zones, ZoneSums, grid_over
from dougong.threads import ahead
from dougong.typing import Index, Kind, Mask, Points, Values

_QUIETER = 0.67
"""The noise of one source in a zone / that of the other, below which it is the better one there."""
_LOOK_M = 0.2
"""How far from a point the other source is looked for at all."""
_MICRON = 1e-6
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

    frame: Frame
    points: int
    pieces: Pieces
    source_id: int
    name: str
    kind: Kind


@dataclass(frozen=True, slots=True, kw_only=True)
class Merged:
    """What is kept of each part, and why the rest is not."""

    remaining: tuple[Remaining, ...]
    """Of each part."""
    mode: Literal["best", "all"]
    noise_m: dict[str, float] = field(default_factory=dict)
    """Median noise of the flat zones, by kind."""
    reach_m: float | None = None
    note: str = ""

    def document(self, parts: Sequence[Part]) -> dict[str, Any]:
        """Return the books: what was kept and left out of each source."""
        rows: dict[str, dict[str, int]] = {}
        for part, remaining in zip(parts, self.remaining, strict=True):
            row = rows.setdefault(part.name, {"points": 0, "left_out": 0})
            gone = remaining.gone()
            row["points"] += part.points - gone
            row["left_out"] += gone
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


def choose(parts: Sequence[Part], params: Merge, hold: Hold | None = None) -> Merged:
    """Return which points of each part go into the merged cloud.

    With `hold`, sets of more points than that are worked on in tiles in its folder. Deterministic;
    independent of the order of parts and points, of the tiles and of the thread count. Tile class:
    two-pass (zones, then their reach), halo twice the reach.
    """
    remaining = [Remaining(LeftOut(), 0, part.points) for part in parts]
    if params.mode == "all":
        return Merged(remaining=tuple(remaining), mode="all")
    groups: dict[Kind, list[int]] = {}
    for place, part in enumerate(parts):
        if part.points:
            groups.setdefault(part.kind, []).append(place)
    if len(groups) < 2:
        note = "one kind of sensor only: nothing to choose between"
        return Merged(remaining=tuple(remaining), mode="best", note=note)
    kinds = sorted(groups)
    sets = [[parts[place] for place in groups[kind]] for kind in kinds]
    is_held = _are_held(sets, hold)
    folder = None if is_held or hold is None else hold.folder / "merge"
    found = better_of(_tiles_of(sets[0], sets[1], hold), params, folder)
    for kind, left_out in zip(kinds, found.left_out, strict=True):
        first = 0
        for place in groups[kind]:
            remaining[place] = Remaining(left_out, first, parts[place].points)
            first += parts[place].points
    return Merged(
        remaining=tuple(remaining),
        mode="best",
        noise_m=dict(zip(kinds, found.noise_m, strict=True)),
        reach_m=found.reach_m,
        note=found.note,
    )


def _are_held(sets: Sequence[Sequence[Part]], hold: Hold | None) -> bool:
    return hold is None or sum(part.points for side in sets for part in side) <= hold.points


def _tiles_of(one: Sequence[Part], other: Sequence[Part], hold: Hold | None) -> Tiles:
    """Return the points of two sensors as tiles: one that is held, where `hold` has room for it."""
    origin = one[0].frame.origin
    streams = [
        (piece.rebased(origin).xyz for part in side for piece in part.pieces())
        for side in (one, other)
    ]
    if hold is None or _are_held((one, other), hold):
        return whole(*(np.concatenate(list(stream)) for stream in streams))
    most = max(hold.points // HALO_SHARE, 1)
    return cut((streams[0], streams[1]), hold.folder / "merge", most)


@dataclass(frozen=True, slots=True, kw_only=True)
class Chosen:
    """What is left out of two point sets."""

    left_out: tuple[LeftOut, LeftOut]
    noise_m: tuple[float, float]
    reach_m: float | None
    note: str = ""


def better_of(tiles: Tiles, params: Merge, folder: Path | None = None) -> Chosen:
    """Return which points of two sensors stay.

    `folder` gets the places of those that do not; None: they are held.
    """
    grid = grid_over(
        (points for sides in ahead(tiles(0.0)) for points in sides.points), params.zone_m
    )
    sums = (ZoneSums(grid), ZoneSums(grid))
    for sides in ahead(tiles(0.0)):
        for side in (0, 1):
            if len(sides.rows[side]):
                sums[side].add(sides.own(side))
    zones = (sums[0].zones(), sums[1].zones())
    one, other = (None if folder is None else folder / f"left-out-{k}" for k in (0, 1))
    left_out = (LeftOut(one), LeftOut(other))
    noise = (zones[0].typical_noise_m, zones[1].typical_noise_m)
    if not np.isfinite(noise).all():
        note = "a cloud has no flat zone to judge its noise by: every point was kept"
        return Chosen(left_out=left_out, noise_m=noise, reach_m=None, note=note)
    good = 0 if noise[0] <= noise[1] else 1
    rule = _Rule(
        better=zones[good],
        worse=zones[1 - good],
        is_reversed=_reversed_zones(zones[good], zones[1 - good]),
        params=params,
    )
    reach = params.reach_m or _reach(tiles, good, rule)
    for sides in ahead(tiles(2.0 * reach)):
        lost = _lost(sides.points[good], sides.points[1 - good], reach, rule)
        for side, is_lost in ((good, lost[0]), (1 - good, lost[1])):
            own = sides.rows[side]
            left_out[side].add(own[is_lost[: len(own)]])
    return Chosen(left_out=left_out, noise_m=noise, reach_m=reach)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Rule:
    """What is known of both whole sets before any point is judged."""

    better: Zones
    worse: Zones
    is_reversed: Index
    """Keys of zones in which the noisier cloud is clearly the quieter one."""
    params: Merge


def _lost(better: Points, worse: Points, reach: float, rule: _Rule) -> tuple[Mask, Mask]:
    """Return which points of either set a better source stands in for.

    What a point of the worse set rests on lies within the reach, and what that rests on within as
    much again: twice the reach is the halo.
    """
    # Where the worse cloud is the better one, its points stay and stand in for the other's.
    stands_in = rule.worse.are_in(worse, rule.is_reversed)
    lost_better = np.zeros(len(better), dtype=bool)
    if stands_in.any():
        candidates = np.flatnonzero(rule.better.are_in(better, rule.is_reversed))
        lost_better[candidates] = _covered(
            better[candidates], rule.better, worse[stands_in], rule.worse, reach, rule.params
        )
    candidates = np.flatnonzero(~stands_in)
    lost_worse = np.zeros(len(worse), dtype=bool)
    lost_worse[candidates] = _covered(
        worse[candidates], rule.worse, better[~lost_better], rule.better, reach, rule.params
    )
    return lost_better, lost_worse


def _reversed_zones(better: Zones, worse: Zones) -> Index:
    """Return the keys of zones in which the noisier cloud is clearly the quieter one."""
    at, is_there = worse.find(better.keys)
    with np.errstate(invalid="ignore"):
        is_quieter = worse.noise_m[at] < _QUIETER * better.noise_m
    return better.keys[is_there & is_quieter]


def _reach(tiles: Tiles, good: int, rule: _Rule) -> float:
    """Return how far across the surface the two clouds lie from each other, with noise."""
    # Whole micrometres are counted: exact whatever the tiles, and nothing is held.
    counts = np.zeros(int(_LOOK_M / _MICRON) + 2, np.int64)
    for sides in ahead(tiles(_LOOK_M)):
        across = _across(sides.points[good], sides.own(1 - good), rule)
        counts += np.bincount(np.rint(across / _MICRON).astype(np.int64), minlength=len(counts))
    if not counts.any():
        return _REACH_M[0]
    before = np.cumsum(counts)
    last = int(before[-1])
    middle = np.searchsorted(before, [(last - 1) // 2, last // 2], side="right").mean() * _MICRON
    return float(np.clip(_REACH_MEDIANS * middle, *_REACH_M))


def _across(better: Points, worse: Points, rule: _Rule) -> Values:
    """Return the distances across the surface of the worse points where both are dense."""
    if not len(better) or not len(worse):
        return np.empty(0)
    asked = worse[_is_dense(worse, rule.worse, rule.better, rule.params)]
    place, distance = nearest(build_index(better), asked, _LOOK_M)
    hit = np.flatnonzero(place >= 0)
    zone = rule.better.of(better[place[hit]])
    gap = asked[hit] - better[place[hit]]
    is_over = _is_over(gap, distance[hit], rule.better, zone)
    is_flat = is_over & np.isfinite(rule.better.noise_m[zone])
    across: Values = np.abs(np.einsum("ij,ij->i", gap, rule.better.normals[zone]))[is_flat]
    return across


def _is_dense(points: Points, own: Zones, other: Zones, params: Merge) -> Mask:
    """Return where the `other` source has its share of the density about each of `points`."""
    keys, place, _ = grouped(own.grid.keys(own.grid.cells(points)))
    is_dense: Mask = other.around(keys) >= params.min_density_share * own.around(keys)
    return is_dense[place]


def _covered(
    points: Points, own: Zones, by: Points, zones: Zones, reach: float, params: Merge
) -> Mask:
    """Return which `points` the points `by`, of `zones`, stand in for; `own`: their own zones."""
    is_covered = np.zeros(len(points), dtype=bool)
    if not len(points) or not len(by):
        return is_covered
    dense = np.flatnonzero(_is_dense(points, own, zones, params))
    place, distance = nearest(build_index(by), points[dense], reach)
    hit = np.flatnonzero(place >= 0)
    zone = zones.of(by[place[hit]])
    gap = points[dense[hit]] - by[place[hit]]
    is_covered[dense[hit]] = _is_over(gap, distance[hit], zones, zone)
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
