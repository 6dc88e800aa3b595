"""What a ruling comes to: `ok`, `ambiguous` or `failed`, why in words, and what would decide."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from dougong.registration.result import FineResult, Status
from dougong.registration.symmetry import in_words, move_between
from dougong.registration.verdict import Ruling, Verdict


def status_of(ruling: Ruling, fine: FineResult | None, params: Verdict) -> tuple[Status, str]:
    """Return the status and, in words, what was seen and what would decide."""
    refusal = _refusal(ruling, fine, params)
    if ruling.overruled is not None:
        # Where they say, no pose need hold: that is no word against the clouds.
        return "ambiguous" if refusal is None else "failed", (
            f"the clouds contradict {ruling.contradicted}: a pose elsewhere explains "
            f"{100 * ruling.overruled.gain:.1f} % more of the surface (p = "
            f"{max(ruling.overruled.p_value, 1e-9):.1g}). Check them, or register without them."
        )
    if refusal is not None:
        return "failed", refusal
    if ruling.undecided:
        moves = [move_between(ruling.winner.T, c.T, ruling.middle) for c in ruling.undecided]
        return "ambiguous", in_words(moves)
    loose: Sequence[Mapping[str, Any]] = fine.unobservable if fine is not None else ()
    if loose:
        texts = "; ".join(str(item["text"]) for item in loose)
        return "ambiguous", (
            f"the shared surface does not hold the pose: it {texts}. Control points, or surface "
            "facing that way in both clouds, would decide."
        )
    beaten = ruling.told or (
        f"the next pose contradicts {100 * ruling.beaten[0].gain:.1f} % more of the surface "
        f"(p = {max(ruling.beaten[0].p_value, 1e-9):.1g} over {ruling.beaten[0].blocks} blocks)"
        if ruling.beaten
        else "no other pose fits at all"
    )
    return "ok", (
        f"the pose explains {100 * ruling.explained:.0f} % of the structure near the other cloud, "
        f"{ruling.sharpness:.1f} times what a pose half a metre beside it does; {beaten}."
    )


def _refusal(ruling: Ruling, fine: FineResult | None, params: Verdict) -> str | None:
    """Return why the best pose is none; None: it may be one."""
    if fine is not None and fine.fitness <= 0.0:
        return "no pose lays one cloud on the other: nothing matches after refinement."
    overlap = max(fine.overlap_source, fine.overlap_target) if fine is not None else 1.0
    if ruling.sharpness < params.least_sharpness or ruling.explained < params.least_explained:
        return (
            f"the best pose explains {100 * ruling.explained:.0f} % of the structure near the "
            f"other cloud, {ruling.sharpness:.1f} times what a pose half a metre beside it does "
            f"(at least {100 * params.least_explained:.0f} % and {params.least_sharpness:g} times "
            "expected). Are these two clouds of the same place, in the same unit, with z up, and "
            "do they overlap?"
        )
    if overlap < params.least_overlap:
        return (
            f"only {100 * overlap:.0f} % of either cloud has the other within reach (at least "
            f"{100 * params.least_overlap:.0f} % expected). Scan more of what both show; where "
            "they are known to share so little, allow less (least_overlap) and check the result."
        )
    if ruling.violation > params.most_violation:
        return (
            f"under the best pose {100 * ruling.violation:.0f} % of the structure stands where the "
            f"other cloud saw free space (at most {100 * params.most_violation:.0f} % expected): "
            "the true pose was not found, or the place was rebuilt. A yaw hint or control points "
            "would help."
        )
    return None
