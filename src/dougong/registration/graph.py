"""Many clouds: pairwise links adjusted together, loop errors, and the link that is wrong, by name.

Every link is a registration of one cloud onto another with its covariance. Where links close loops
they check each other: all poses are adjusted at once (sparse least squares), each link counts by
its covariance, and one that the loops contradict loses its weight step by step (a Cauchy weight
whose width shrinks, so that no start decides which link is the odd one) and is named.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csc_matrix
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from dougong.registration.icp_solve import FREE, moved_by
from dougong.registration.overlap import apply, inverse
from dougong.typing import Transform, Values

_WIDTHS = (300.0, 100.0, 30.0, 10.0, 5.0, 3.0, 3.0, 3.0, 3.0, 3.0)
"""Normalised residual at which a link's weight is half, step by step."""
_BAD = 4.0
_BAD_M = 0.02
_BAD_DEG = 0.05
_FLOOR = np.array([2e-5] * 3 + [5e-4] * 3)
"""Standard deviations (rad, m) that no link can beat."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Link:
    """One registration between two clouds."""

    source: str
    target: str
    T_target_source: Transform
    """Rigid, between the local frames."""
    covariance: NDArray[np.float64]
    """(6, 6) of (omega rad, v m) about `about`."""
    about: Values
    """(3,), local frame of the target."""

    @property
    def name(self) -> str:
        """Return how the link is called in words."""
        return f"{self.source} -> {self.target}"


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkReport:
    """What the network says of one link."""

    source: str
    target: str
    is_checked: bool
    """False: it closes no loop, so that nothing can contradict it."""
    is_bad: bool
    """The other links contradict it; it counts for nothing."""
    weight: float
    """0..1, what is left of its weight."""
    loop_error_m: float
    """Miss at the middle of its overlap against the poses adjusted without it; 0 if unchecked."""
    loop_error_deg: float
    normalised: float
    """Its residual in the adjusted network in units of its covariance."""

    @property
    def name(self) -> str:
        """Return how the link is called in words."""
        return f"{self.source} -> {self.target}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Network:
    """All clouds in the frame of the reference."""

    poses: Mapping[str, Transform]
    """Of every cloud that a chain of links joins to the reference."""
    covariances: Mapping[str, NDArray[np.float64]]
    """(6, 6) of each pose about the image of its cloud's origin, reference frame."""
    links: tuple[LinkReport, ...]
    unreached: tuple[str, ...]

    @property
    def bad(self) -> tuple[str, ...]:
        """Return the names of the links that the others contradict."""
        return tuple(link.name for link in self.links if link.is_bad)


def adjust_network(
    names: Sequence[str], reference: str, links: Sequence[Link], *, dof: int = 6
) -> Network:
    """Adjust all poses together.

    Parameters
    ----------
    names : sequence of str
        Every cloud.
    reference : str
        The one that stays.
    links : sequence of Link
    dof : {6, 4}
        4: every cloud only turns about the vertical (all are levelled).

    Returns
    -------
    Network

    Notes
    -----
    Deterministic; the cost grows with the number of links.
    """
    index = {name: k for k, name in enumerate(names)}
    joined = _joined(index, links)
    reached = [name for name in names if joined[index[name]] == joined[index[reference]]]
    own = [link for link in links if link.source in reached and link.target in reached]
    poses = _start(index, reference, own)
    order = [name for name in reached if name != reference]
    weights = np.ones(len(own))
    system = _System(order=order, links=own, dof=dof)
    for width in _WIDTHS if own else ():
        poses = system.stepped(poses, weights)
        weights = np.asarray(1.0 / (1.0 + np.square(system.sizes(poses) / width)), dtype=np.float64)
    covariances = system.covariances(poses, weights) if order else {}
    reports = tuple(
        _report(k, system, poses, weights, _joined(index, own[:k] + own[k + 1 :]), index)
        for k in range(len(own))
    )
    return Network(
        poses=poses,
        covariances=covariances,
        links=reports,
        unreached=tuple(name for name in names if name not in reached),
    )


def _joined(index: Mapping[str, int], links: Sequence[Link]) -> NDArray[np.int64]:
    rows = [index[link.source] for link in links]
    columns = [index[link.target] for link in links]
    shape = (len(index), len(index))
    graph = coo_matrix((np.ones(len(links)), (rows, columns)), shape=shape)
    parts: NDArray[np.int64] = connected_components(graph, directed=False)[1]
    return parts


def _start(index: Mapping[str, int], reference: str, links: Sequence[Link]) -> dict[str, Transform]:
    """Return poses along the tree of the surest links."""
    poses = {reference: np.eye(4)}
    if not links:
        return poses
    best: dict[tuple[int, int], tuple[float, int]] = {}
    for k, link in enumerate(links):
        ends = sorted((index[link.source], index[link.target]))
        size = 1.0 + float(np.sqrt(np.trace(link.covariance[3:, 3:])))
        key = (ends[0], ends[1])
        best[key] = min(best.get(key, (np.inf, k)), (size, k))
    rows, columns = zip(*best, strict=True)
    sizes = [size for size, _ in best.values()]
    tree = minimum_spanning_tree(csc_matrix((sizes, (rows, columns)), shape=(len(index),) * 2))
    chosen = [links[best[tuple(sorted(pair))][1]] for pair in zip(*tree.nonzero(), strict=True)]
    while chosen:
        left = []
        for link in chosen:
            if link.target in poses:
                poses[link.source] = poses[link.target] @ link.T_target_source
            elif link.source in poses:
                poses[link.target] = poses[link.source] @ inverse(link.T_target_source)
            else:
                left.append(link)
        chosen = left
    return poses


@dataclass(frozen=True, slots=True, kw_only=True)
class _System:
    """The normal equations of a network."""

    order: Sequence[str]
    links: Sequence[Link]
    dof: int

    def residual(self, link: Link, poses: Mapping[str, Transform]) -> Values:
        """Return (omega, v) by which the poses miss the link, target frame, about its middle."""
        found = inverse(poses[link.target]) @ poses[link.source] @ inverse(link.T_target_source)
        turn = Rotation.from_matrix(found[:3, :3]).as_rotvec()
        miss: Values = np.concatenate([turn, apply(found, link.about[None])[0] - link.about])
        return miss

    def sizes(self, poses: Mapping[str, Transform]) -> Values:
        """Return the normalised residual of each link."""
        sizes = []
        for link in self.links:
            miss = self.residual(link, poses)
            sizes.append(np.sqrt(miss @ _information(link) @ miss / 6.0))
        return np.array(sizes)

    def normal(self, poses: Mapping[str, Transform], weights: Values) -> tuple[csc_matrix, Values]:
        """Return H and g over the clouds in order, about the image of each cloud's origin."""
        free = list(FREE[self.dof])
        size, place = len(free), {name: k for k, name in enumerate(self.order)}
        data: list[Values] = []
        rows: list[Values] = []
        columns: list[Values] = []
        g = np.zeros(size * len(self.order))
        for link, weight in zip(self.links, weights, strict=True):
            information = weight * _information(link)
            miss, J = self.residual(link, poses), self._jacobians(link, poses)
            ends = [(n, J[n][:, free]) for n in (link.source, link.target) if n in place]
            for one, A in ends:
                at = size * place[one] + np.arange(size)
                g[at] += A.T @ information @ miss
                for other, B in ends:
                    to = size * place[other] + np.arange(size)
                    data.append((A.T @ information @ B).ravel())
                    rows.append(np.repeat(at, size))
                    columns.append(np.tile(to, size))
        shape = (len(g), len(g))
        parts = (np.concatenate(rows), np.concatenate(columns))
        return csc_matrix((np.concatenate(data), parts), shape=shape), g

    def _jacobians(
        self, link: Link, poses: Mapping[str, Transform]
    ) -> dict[str, NDArray[np.float64]]:
        back = poses[link.target][:3, :3].T
        middle = apply(poses[link.target], link.about[None])[0]
        found = {}
        for name, sign in ((link.source, 1.0), (link.target, -1.0)):
            x, y, z = middle - poses[name][:3, 3]
            J = np.zeros((6, 6))
            J[:3, :3], J[3:, 3:] = back, back
            # omega x arm = -[arm]x omega
            J[3:, :3] = back @ np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
            found[name] = sign * J
        return found

    def stepped(self, poses: Mapping[str, Transform], weights: Values) -> dict[str, Transform]:
        """Return the poses after one Gauss-Newton step."""
        H, g = self.normal(poses, weights)
        free = list(FREE[self.dof])
        steps = np.zeros((len(self.order), 6))
        steps[:, free] = splu(H).solve(-g).reshape(len(self.order), -1)
        moved = dict(poses)
        for name, step in zip(self.order, steps, strict=True):
            moved[name] = moved_by(poses[name], step, poses[name][:3, 3].copy())
        return moved

    def covariances(
        self, poses: Mapping[str, Transform], weights: Values
    ) -> dict[str, NDArray[np.float64]]:
        """Return the (6, 6) of each cloud, its block of the inverse; locked rows zero."""
        H, _ = self.normal(poses, weights)
        solver, free = splu(H), list(FREE[self.dof])
        found = {}
        for k, name in enumerate(self.order):
            unit = np.zeros((H.shape[0], len(free)))
            unit[len(free) * k + np.arange(len(free)), np.arange(len(free))] = 1.0
            block = solver.solve(unit)[len(free) * k : len(free) * (k + 1)]
            found[name] = np.zeros((6, 6))
            found[name][np.ix_(free, free)] = 0.5 * (block + block.T)
        return found


def _information(link: Link) -> NDArray[np.float64]:
    floored = link.covariance + np.diag(np.square(_FLOOR))
    return np.asarray(np.linalg.inv(floored), dtype=np.float64)


def _report(
    k: int,
    system: _System,
    poses: Mapping[str, Transform],
    weights: Values,
    joined_without: NDArray[np.int64],
    index: Mapping[str, int],
) -> LinkReport:
    link = system.links[k]
    size = float(system.sizes(poses)[k])
    is_checked = bool(joined_without[index[link.source]] == joined_without[index[link.target]])
    error_m, error_deg = 0.0, 0.0
    if is_checked:
        others = weights.copy()
        others[k] = 0.0
        miss = system.residual(link, system.stepped(poses, others))
        error_m = float(np.linalg.norm(miss[3:]))
        error_deg = float(np.degrees(np.linalg.norm(miss[:3])))
    is_large = error_m > _BAD_M or error_deg > _BAD_DEG
    return LinkReport(
        source=link.source,
        target=link.target,
        is_checked=is_checked,
        is_bad=is_checked and size > _BAD and is_large,
        weight=float(weights[k]),
        loop_error_m=error_m,
        loop_error_deg=error_deg,
        normalised=size,
    )
