"""Many clouds in one frame: which pairs are registered, and what their links say together.

1. Reach: a cloud is tried against clouds whose place is known, the likeliest first, until one holds
   it: the reference if it is a flight (it covers the site), clouds that its file's poses put
   beside it, then those recorded just before and after.
2. Check: pairs that overlap under the poses so found are registered too, each by a search of its
   own, so that loops close and can contradict.
3. Join: all links are adjusted together (`registration.network`); what is contradicted is named.

Two clouds are one link: nothing is added to it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from dougong._sorting import distinct
from dougong.cloud import Cloud, Frame
from dougong.errors import RegistrationError
from dougong.pipeline.control import control_of
from dougong.pipeline.links import Linked, register_pair
from dougong.pipeline.movers import Mover, ReducedClouds
from dougong.pipeline.progress import Progress
from dougong.pipeline.registering import impossible
from dougong.registration import Register
from dougong.registration.control_solve import ControlPoints
from dougong.registration.network import Joined, PairLink, is_adjustable, join, local_matrix
from dougong.registration.result import Hypothesis, Registration
from dougong.typing import Transform

_TRIES = 4
"""Clouds that are tried in a round, before a cloud waits for others to be placed."""
_MOST_TRIES = 12
_LEAST_OVERLAP = 0.2
"""Share of the smaller cloud's cells that the other one has too, for a pair worth checking."""
_DOUBT = 0.35
"""Share from which a pair that is not registered with certainty speaks against the poses."""
_LINKS = 3
"""Links that every cloud should have, where its overlaps allow it."""
_CELL_M = 0.5
_MOST_CELLS = 200_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Frames:
    """Where every cloud of a project stands, and the links that hold them."""

    linked: list[Linked]
    document: dict[str, Any] | None
    """``network`` of result.json; None with fewer than three clouds."""


@dataclass(slots=True, kw_only=True)
class _Search:
    """The pairs tried so far."""

    movers: Mapping[str, Mover]
    reference: str
    params: Register
    control: Mapping[str, ControlPoints]
    progress: Progress
    clouds: ReducedClouds
    tried: dict[tuple[str, str], Registration] = field(default_factory=dict)
    errors: list[RegistrationError] = field(default_factory=list)
    """Why searches could not start."""

    def cloud(self, name: str) -> Cloud:
        """Return the reduced cloud of a mover."""
        return self.clouds.of(name).cloud

    def registered(self, source: str, target: str) -> Registration:
        """Register a pair, once.

        Raises
        ------
        RegistrationError
            There are two clouds, and no pose can even be looked for.
        """
        known = self.tried.get((source, target))
        control = self.control if target == self.reference else {}
        if known is None:
            try:
                known = register_pair(
                    self.movers[source],
                    self.movers[target],
                    (self.cloud(source), self.cloud(target)),
                    self.params,
                    control,
                    self.progress,
                )
            except RegistrationError as error:
                if len(self.movers) == 2:
                    raise
                self.progress.note(f"{source} -> {target} is failed: {error}")
                # One of many: the others go on.
                self.errors.append(error)
                surveyed = control_of(control, source, self.movers[source].entry)
                known = impossible(error, self.params, surveyed)
            self.tried[source, target] = known
        return known

    def is_tried(self, one: str, other: str) -> bool:
        """Say whether a pair was registered, either way round."""
        return (one, other) in self.tried or (other, one) in self.tried

    def links(self) -> list[PairLink]:
        """Return what may be adjusted."""
        return [
            PairLink(source=source, target=target, result=result)
            for (source, target), result in self.tried.items()
            if is_adjustable(result)
        ]


def register_all(
    movers: Sequence[Mover],
    reference: Mover,
    params: Register,
    control: Mapping[str, ControlPoints],
    progress: Progress,
    clouds: ReducedClouds,
) -> Frames:
    """Bring every mover into the frame of the reference.

    Parameters
    ----------
    movers : sequence of Mover
    reference : Mover, one of them
    params : Register
    control : mapping of str to ControlPoints
        By cloud, see `pipeline.control`.
    progress : Progress
    clouds : ReducedClouds, of `movers`

    Raises
    ------
    RegistrationError
        No pair's search can start: the reference has too few points, or is not levelled.
    """
    search = _Search(
        movers={mover.name: mover for mover in movers},
        reference=reference.name,
        params=params.model_copy(update={"filtered": True}),
        control=control,
        progress=progress,
        clouds=clouds,
    )
    parents = _reach(search)
    if search.errors and len(search.errors) == len(search.tried):
        raise search.errors[0]
    joined = None
    if len(movers) > 2:
        doubts = _check(search, parents)
        frames = {name: search.cloud(name).frame for name in search.movers}
        dof = 4 if params.dof == 4 else 6
        joined = join(frames, reference.name, search.links(), doubts, dof=dof)
        _say(joined, progress)
    linked = [
        Linked(
            mover=mover,
            result=None
            if mover is reference
            else _result(search, mover.name, parents.get(mover.name), joined),
            accepts_best=params.accept_best,
        )
        for mover in movers
    ]
    return Frames(linked=linked, document=None if joined is None else _document(search, joined))


def _reach(search: _Search) -> dict[str, str]:
    """Place clouds one by one; return by which cloud each of them is held."""
    parents: dict[str, str] = {}
    placed = [search.reference]
    waiting = [name for name in search.movers if name != search.reference]
    tries = dict.fromkeys(waiting, 0)
    moved = True
    while waiting and moved:
        moved = False
        for name in list(waiting):
            held = _held_by(search, name, placed, tries)
            if held is not None:
                parents[name] = held
                placed.append(name)
                waiting.remove(name)
                moved = True
    for name in waiting:
        # What its registration onto the reference says is what the user can act on.
        search.registered(name, search.reference)
    return parents


def _held_by(
    search: _Search, name: str, placed: Sequence[str], tries: dict[str, int]
) -> str | None:
    """Return the first of the likeliest placed clouds onto which `name` registers."""
    left = [other for other in placed if (name, other) not in search.tried]
    for other in _likeliest(search, name, left)[:_TRIES]:
        if tries[name] >= _MOST_TRIES:
            return None
        tries[name] += 1
        if search.registered(name, other).status == "ok":
            return other
    return None


def _likeliest(search: _Search, name: str, others: Sequence[str]) -> list[str]:
    """Return the clouds that `name` may register onto, the likeliest first."""
    order = {other: k for k, other in enumerate(search.movers)}
    mine = search.movers[name]

    def rank(other: str) -> tuple[int, int]:
        mover = search.movers[other]
        covers = other == search.reference and mover.kind == "photogrammetry"
        return (0 if covers else 1, abs(order[other] - order[name]))

    # A cloud whose scale was found against the reference has no other link.
    able = [
        other
        for other in others
        if other == search.reference or (mine.scale is None and search.movers[other].scale is None)
    ]
    return sorted(able, key=rank)


def _check(search: _Search, parents: Mapping[str, str]) -> list[tuple[str, str]]:
    """Register more pairs that overlap, until every cloud has enough links to be contradicted.

    Returns the pairs that should have confirmed the poses, and did not.
    """
    doubts = []
    links = search.links()
    count = dict.fromkeys(search.movers, 0)
    for link in links:
        count[link.source] += 1
        count[link.target] += 1
    poses = _tree_poses(search, parents)
    cells = {name: _cells(search, name, T) for name, T in poses.items()}
    pairs = sorted(
        (
            (_shared(cells[one], cells[other]), one, other)
            for k, one in enumerate(cells)
            for other in list(cells)[k + 1 :]
            if not search.is_tried(one, other)
        ),
        key=lambda pair: (-pair[0], pair[1], pair[2]),
    )
    for share, one, other in pairs:
        is_enough = min(count[one], count[other]) >= _LINKS or max(count[one], count[other]) > 8
        if share < _LEAST_OVERLAP or is_enough:
            continue
        source, target = (other, one) if one == search.reference else (one, other)
        if is_adjustable(search.registered(source, target)):
            count[one] += 1
            count[other] += 1
        elif share >= _DOUBT:
            doubts.append((one, other))
    return doubts


def _tree_poses(search: _Search, parents: Mapping[str, str]) -> dict[str, Transform]:
    """Return the poses (file to reference file) along the links that placed the clouds.

    Only of clouds whose links may be adjusted.
    """
    poses = {search.reference: np.eye(4)}
    for name, parent in parents.items():
        result = search.tried[name, parent]
        is_able = search.movers[name].scale is None and is_adjustable(result)
        if parent in poses and is_able and result.matrix is not None:
            poses[name] = poses[parent] @ result.matrix
    return poses


def _cells(search: _Search, name: str, T: Transform) -> frozenset[int]:
    """Return the cells of space, in the reference's frame, that a cloud has points in."""
    cloud = search.cloud(name)
    local = local_matrix(T, cloud.frame, search.cloud(search.reference).frame)
    step = max(1, len(cloud.xyz) // _MOST_CELLS)
    cell = np.floor((cloud.xyz[::step] @ local[:3, :3].T + local[:3, 3]) / _CELL_M)
    key = (cell + (1 << 20)).astype(np.int64)
    return frozenset(distinct((key[:, 0] << 42) | (key[:, 1] << 21) | key[:, 2]).tolist())


def _shared(one: frozenset[int], other: frozenset[int]) -> float:
    return len(one & other) / max(min(len(one), len(other)), 1)


def _result(search: _Search, name: str, parent: str | None, joined: Joined | None) -> Registration:
    """Return the registration of a cloud onto the reference, by whatever way it was reached."""
    reference = search.reference
    if parent is None:
        return search.tried[name, reference]
    held = search.tried[name, parent]
    if joined is None or not is_adjustable(held):
        return held
    parent, held = _good_link(search, name, parent, joined)
    if name not in joined.matrices or name in joined.contradicted:
        return _unsure(name, held, joined)
    frames: tuple[Frame, Frame] = (search.cloud(name).frame, search.cloud(reference).frame)
    matrix, own = joined.matrices[name], _checked(name, joined)
    way = "" if parent == reference else f" Reached through {parent}: {held.reason}"
    if not own and parent == reference:
        return held
    assert held.fine is not None
    return replace(
        held,
        matrix=matrix,
        scale=float(np.cbrt(np.linalg.det(matrix[:3, :3]))),
        reason=f"{own or 'one link holds it, and nothing checks that link.'}{way}".strip()
        if parent != reference
        else f"{held.reason} {own}",
        hypotheses=_composed(held, parent, search, joined),
        fine=replace(
            held.fine,
            T_target_source=local_matrix(matrix, *frames),
            covariance=joined.covariances[name],
            covariance_about=joined.about[name],
        ),
    )


def _good_link(search: _Search, name: str, parent: str, joined: Joined) -> tuple[str, Registration]:
    """Return the link that placed a cloud, or another of its own where that one proved wrong."""
    bad = {(link.source, link.target) for link in joined.links if link.is_bad}
    own = [
        other
        for (source, other), result in search.tried.items()
        if source == name and is_adjustable(result) and (source, other) not in bad
    ]
    parent = parent if parent in own or not own else own[0]
    return parent, search.tried[name, parent]


def _composed(
    held: Registration, parent: str, search: _Search, joined: Joined
) -> tuple[Hypothesis, ...]:
    """Return the hypotheses of a link in the reference's file coordinates."""
    if parent == search.reference or parent not in joined.matrices:
        return held.hypotheses
    on = joined.matrices[parent]
    return tuple(replace(one, T_target_source=on @ one.T_target_source) for one in held.hypotheses)


def _checked(name: str, joined: Joined) -> str:
    """Return what other links say of a cloud's place; empty where nothing checks it."""
    own = [
        link
        for link in joined.links
        if name in (link.source, link.target) and link.is_checked and not link.is_bad
    ]
    if not own:
        return ""
    worst = max(own, key=lambda link: link.loop_error_m)
    return (
        f"{len(own)} links that check each other hold it; the largest loop error is "
        f"{1e3 * worst.loop_error_m:.0f} mm, {worst.loop_error_deg:.3f} deg ({worst.name})."
    )


def _unsure(name: str, held: Registration, joined: Joined) -> Registration:
    """Return a cloud's link as ambiguous: the network contradicts what holds it."""
    bad = ", ".join(link.name for link in joined.links if link.is_bad)
    why = (
        f"links contradict each other ({bad} was left out), and too few others remain to tell "
        "which of them is wrong"
        if bad
        else "one link alone holds it, and other clouds that overlap by it do not confirm it"
    )
    reason = f"{why}. Scan more overlap, or give a yaw hint or control points."
    return replace(
        held, status="ambiguous", reason=reason, matrix=joined.matrices.get(name, held.matrix)
    )


def _say(joined: Joined, progress: Progress) -> None:
    for link in joined.links:
        if link.is_bad:
            progress.note(
                f"the link {link.name} is wrong by {link.loop_error_m:.2g} m, "
                f"{link.loop_error_deg:.2g} deg by the other links: it is left out"
            )


def _document(search: _Search, joined: Joined) -> dict[str, Any]:
    """Return ``network``: every pair that was tried, and what the loops say of its link."""
    reports = {report.name: report for report in joined.links}
    rows = []
    for (source, target), result in search.tried.items():
        report = reports.get(f"{source} -> {target}")
        rows.append(
            {
                "source": source,
                "target": target,
                "status": result.status,
                "reason": result.reason,
                "overlap": None
                if result.fine is None
                else max(result.fine.overlap_source, result.fine.overlap_target),
                "is_checked": report is not None and report.is_checked,
                "is_left_out": report is not None and report.is_bad,
                "weight": None if report is None else report.weight,
                "loop_error_m": None
                if report is None or not report.is_checked
                else report.loop_error_m,
                "loop_error_deg": None
                if report is None or not report.is_checked
                else report.loop_error_deg,
                "normalised_residual": None if report is None else report.normalised,
            }
        )
    return {
        "links": rows,
        "unreached": [name for name in search.movers if name not in joined.matrices],
        "contradicted": list(joined.contradicted),
    }
