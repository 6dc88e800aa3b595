"""How one cloud is registered to another: every setting, in one model."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, field_validator, model_validator

from dougong.params import Parameters
from dougong.registration.congruent_sets import CongruentSets
from dougong.registration.icp import Icp
from dougong.registration.plan_search import PlanSearch
from dougong.registration.prepare import Prepare
from dougong.registration.principal_axes import ImprovedPca
from dougong.registration.sample_consensus import SacIa
from dougong.registration.verdict import Verdict

Coarse = Literal["auto", "plan", "improved-pca", "pca", "sac-ia", "4pcs", "none"]
_FACTORS = (0.9, 1.1)
"""Combined factors of survey projections, with room to spare."""

_REPLACED = (
    ("plan", "yaw_hint_deg", "yaw_hint_deg"),
    ("icp", "dof", "dof"),
    ("icp", "method", "fine"),
    ("prepare", "is_filtered", "filtered"),
)
"""Fields of the parts, for whoever calls these alone, and those of the whole that replace them."""


class Register(Parameters):
    """How one cloud is registered to another."""

    coarse: Coarse = "auto"
    """Where starting poses come from; auto: the plan search. none: the files' own coordinates."""
    fine: Literal["point-to-plane", "point-to-point", "none"] = "point-to-plane"
    """How the best pose is refined."""
    dof: Literal["auto", 4, 5, 6, 7] = "auto"
    """Degrees of freedom: 4 levelled, 5 levelled with scale, 6 rigid, 7 rigid with scale; auto: 6
    with a gravity prior, and 7 where nothing declares a cloud's unit and it is not the metre."""
    filtered: bool = False
    """The inputs are clean already: nothing is dropped as far, alone or below the ground."""
    yaw_hint_deg: Annotated[float, Field(ge=-360, le=360)] | None = None
    """Known turn from source to target about the vertical, within 15 degrees."""
    grid_scale: Literal["auto", "off"] | float = "auto"
    """Combined factor (grid / ground) of clouds in a map projection; auto: from their system and
    height; off: they are true to scale, as site-calibrated ground systems are."""
    accept_best: bool = False
    """The caller takes the best pose of an ambiguous result; the status stays ambiguous."""
    prepare: Prepare = Prepare()
    plan: PlanSearch = PlanSearch()
    improved_pca: ImprovedPca = ImprovedPca()
    sac_ia: SacIa = SacIa()
    congruent_sets: CongruentSets = CongruentSets()
    icp: Icp = Icp()
    verdict: Verdict = Verdict()

    @field_validator("grid_scale", mode="before")
    @classmethod
    def _is_a_factor_or_a_word(cls, value: object) -> object:
        if value in ("auto", "off"):
            return value
        try:
            factor = float(str(value))
        except ValueError:
            factor = float("nan")
        if not _FACTORS[0] <= factor <= _FACTORS[1]:
            msg = (
                f"{value!r} is neither auto, off nor a factor between {_FACTORS[0]:g} and "
                f"{_FACTORS[1]:g} (grid / ground, such as 0.9996)"
            )
            raise ValueError(msg)
        return factor

    @model_validator(mode="after")
    def _has_no_second_opinion(self) -> Self:
        """Refuse a part's field that one of the whole replaces: it would have no effect."""
        for part, name, instead in _REPLACED:
            value = getattr(getattr(self, part), name)
            if value != type(getattr(self, part)).model_fields[name].default:
                msg = f"{part}.{name} = {value!r} has no effect here: set {instead} instead"
                raise ValueError(msg)
        return self

    @field_validator("dof", mode="before")
    @classmethod
    def _read_a_number(cls, value: object) -> object:
        return int(value) if isinstance(value, str) and value.isdigit() else value
