"""From the registrations of pairs to one frame: which poses the links prove together.

Links that agree are adjusted together (`graph`); one that the others contradict is named and left
out. Where a loop is contradicted but too few links remain to tell which of them is wrong, or pairs
that should confirm a lone link do not, every cloud that hangs on it is unsure.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from dougong.cloud import Frame
from dougong.registration.graph import Link, LinkReport, Network, adjust_network
from dougong.registration.result import Registration
from dougong.typing import Transform


@dataclass(frozen=True, slots=True, kw_only=True)
class PairLink:
    """A sure registration of one cloud of a network onto another."""

    source: str
    target: str
    result: Registration
    """Status ``ok``, with a fine fit and its covariance."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Joined:
    """All clouds in the frame of the reference, and what the links say of each other."""

    matrices: Mapping[str, Transform]
    """File coordinates of a cloud to those of the reference; of every cloud that links reach."""
    covariances: Mapping[str, NDArray[np.float64]]
    """(6, 6) of (omega rad, v m) about `about`, reference frame."""
    about: Mapping[str, NDArray[np.float64]]
    """(3,) image of each cloud's local origin, local frame of the reference."""
    links: tuple[LinkReport, ...]
    """One report per link, in order, of the network with all links in."""
    contradicted: tuple[str, ...]
    """Clouds that hang on one link which others contradict, or should confirm and do not."""


def is_adjustable(result: Registration) -> bool:
    """Say whether a registration may serve as a link: sure, with a known covariance."""
    fine = result.fine
    return result.status == "ok" and fine is not None and fine.covariance is not None


def join(
    frames: Mapping[str, Frame],
    reference: str,
    links: Sequence[PairLink],
    doubts: Sequence[tuple[str, str]] = (),
    *,
    dof: int = 6,
) -> Joined:
    """Adjust all links together.

    Parameters
    ----------
    frames : mapping of str to Frame
        Of every cloud, by name.
    reference : str
    links : sequence of PairLink
        `is_adjustable`, each pair once.
    doubts : sequence of (str, str)
        Pairs that overlap by the links and yet were not registered with certainty: what hangs on
        a single link that such a pair should confirm is unsure.
    dof : {6, 4}
        4: all clouds are levelled, and stay so.
    """
    names = list(frames)
    scales = _scales(reference, frames, links)
    known = [link for link in links if link.source in scales and link.target in scales]
    rigid = [_rigid(link, frames, scales) for link in known]
    whole = adjust_network(names, reference, rigid, dof=dof)
    kept = [link for link, report in zip(rigid, whole.links, strict=True) if not report.is_bad]
    left_out = [link for link, report in zip(rigid, whole.links, strict=True) if report.is_bad]
    final = adjust_network(names, reference, kept, dof=dof) if left_out else whole
    open_pairs = [*((link.source, link.target) for link in left_out), *doubts]
    contradicted = _contradicted(names, reference, kept, final, open_pairs)
    return Joined(
        matrices={
            name: _in_files(T, frames[name], frames[reference], scales[name])
            for name, T in final.poses.items()
        },
        covariances=final.covariances,
        about={name: T[:3, 3] for name, T in final.poses.items()},
        links=whole.links,
        contradicted=contradicted,
    )


def local_matrix(matrix: Transform, source: Frame, target: Frame) -> Transform:
    """Return a matrix between file coordinates as one between local frames, metres."""
    local: Transform = np.linalg.inv(target.T_file_local()) @ matrix @ source.T_file_local()
    return local


def _scales(
    reference: str, frames: Mapping[str, Frame], links: Sequence[PairLink]
) -> dict[str, float]:
    """Return the units of each joined cloud's local frame in metres of the reference.

    A map's metres differ from a scanner's by the grid factor; links between scanners know none.
    """
    scales = {reference: 1.0}
    grows = True
    while grows:
        grows = False
        for link in links:
            if (link.source in scales) == (link.target in scales):
                continue
            T = local_matrix(_matrix(link), frames[link.source], frames[link.target])
            factor = float(np.cbrt(np.linalg.det(T[:3, :3])))
            if link.target in scales:
                scales[link.source] = scales[link.target] * factor
            else:
                scales[link.target] = scales[link.source] / factor
            grows = True
    return scales


def _matrix(link: PairLink) -> Transform:
    if link.result.matrix is None:
        msg = f"the link {link.source} -> {link.target} has no pose."
        raise ValueError(msg)
    return link.result.matrix


def _rigid(link: PairLink, frames: Mapping[str, Frame], scales: Mapping[str, float]) -> Link:
    """Return a link between frames that all have the reference's metres."""
    fine = link.result.fine
    if fine is None or fine.covariance is None:
        msg = f"the link {link.source} -> {link.target} has no covariance."
        raise ValueError(msg)
    T = local_matrix(_matrix(link), frames[link.source], frames[link.target])
    size = scales[link.target]
    factor = float(np.cbrt(np.linalg.det(T[:3, :3])))
    rigid = np.eye(4)
    rigid[:3, :3], rigid[:3, 3] = T[:3, :3] / factor, T[:3, 3] * size
    return Link(
        source=link.source,
        target=link.target,
        T_target_source=rigid,
        covariance=fine.covariance[:6, :6],
        about=fine.covariance_about * size,
    )


def _in_files(T: Transform, source: Frame, reference: Frame, scale: float) -> Transform:
    similar = T.copy()
    similar[:3, :3] *= scale
    matrix: Transform = reference.T_file_local() @ similar @ np.linalg.inv(source.T_file_local())
    return matrix


def _contradicted(
    names: Sequence[str],
    reference: str,
    kept: Sequence[Link],
    network: Network,
    open_pairs: Sequence[tuple[str, str]],
) -> tuple[str, ...]:
    """Return the clouds that hang on a single link which `open_pairs` speak against.

    Without a link that was left out, its loop's others must still check each other: one that
    nothing else checks may as well be the wrong one, and all that it alone holds is unsure.
    """
    unsure: set[str] = set()
    whole = _parts(names, kept)
    for report in network.links:
        if report.is_checked:
            continue
        ends = (report.source, report.target)
        part = _parts(names, [link for link in kept if (link.source, link.target) != ends])
        for one, other in open_pairs:
            if whole[one] == whole[other] and part[one] != part[other]:
                unsure |= {name for name in network.poses if part[name] != part[reference]}
    return tuple(name for name in names if name in unsure)


def _parts(names: Sequence[str], links: Sequence[Link]) -> dict[str, int]:
    index = {name: k for k, name in enumerate(names)}
    ends = ([index[link.source] for link in links], [index[link.target] for link in links])
    graph = coo_matrix((np.ones(len(links)), ends), shape=(len(names), len(names)))
    return dict(zip(names, connected_components(graph, directed=False)[1].tolist(), strict=True))
