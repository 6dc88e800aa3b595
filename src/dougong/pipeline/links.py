"""How each mover of a project gets into the frame of the reference."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from dougong.cloud import Cloud, Frame, Pieces
from dougong.pipeline.control import (
    control_of,
)
from dougong.pipeline.distances import (
    Measured,
    measure,
)
from dougong.pipeline.kept import Kept
from dougong.pipeline.movers import Mover, ReducedClouds
from dougong.pipeline.progress import Progress
from dougong.pipeline.registering import register
from dougong.registration import Register
from dougong.registration.control_solve import ControlPoints
from dougong.registration.result import Registration
from dougong.typing import Transform


@dataclass(frozen=True, slots=True, kw_only=True)
class Linked:
    """A mover and how it got into the reference's frame (None: it is the reference)."""

    mover: Mover
    result: Registration | None
    accepts_best: bool = False
    """The user takes the best pose of an ambiguous registration."""
    measured: Measured | None = None
    """What its registration leaves between it and the reference; None: not sure, or nothing."""

    @property
    def is_sure(self) -> bool:
        """True: its points belong into the merged cloud."""
        if self.result is None or self.result.status == "ok":
            return True
        return self.accepts_best and self.result.matrix is not None

    @property
    def matrix(self) -> Transform | None:
        """(4, 4) from its file coordinates to the reference's; None where that is not sure."""
        if self.result is None:
            return np.eye(4)
        return self.result.matrix if self.is_sure else None

    def placed(self, cloud: Cloud, reference: Frame) -> Cloud:
        """Return a cloud of it in the reference's frame; where that is not known, in its own."""
        if self.result is None or self.matrix is None:
            return cloud
        return cloud.moved(self.matrix, reference)

    def placed_pieces(self, kept: Kept, reference: Frame) -> Pieces:
        """Return what was kept of a file, placed, piece by piece."""
        return lambda: (self.placed(piece, reference) for piece in kept.pieces())


def register_pair(
    source: Mover,
    target: Mover,
    clouds: tuple[Cloud, Cloud],
    params: Register,
    control: Mapping[str, ControlPoints],
    progress: Progress,
) -> Registration:
    """Register one mover onto another; `clouds` are theirs, joined."""
    progress.stage(f"registering {source.name} onto {target.name}")
    result = register(
        *clouds,
        params,
        source_kind=source.kind,
        target_kind=target.kind,
        control=control_of(control, source.name, source.entry),
        scale=source.scale,
        is_declared=True,
    )
    progress.note(f"{source.name} -> {target.name} is {result.status}: {result.reason}")
    return result


def measured_link(
    link: Linked, reference: Mover, clouds: ReducedClouds, progress: Progress
) -> Linked:
    """Return a sure link with the distances that its registration leaves."""
    if link.result is None or not link.is_sure:
        return link
    progress.stage(f"measuring {link.mover.name} against {reference.name}")
    source, target = clouds.of(link.mover.name).cloud, clouds.of(reference.name).cloud
    found = measure(source, target, link.result)
    return replace(link, measured=found)
