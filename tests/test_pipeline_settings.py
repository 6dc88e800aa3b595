"""Settings from text, and pydantic's errors as one clear sentence."""

from typing import Annotated, Literal

import pytest
from pydantic import Field

from dougong.errors import InputError
from dougong.params import Parameters
from dougong.pipeline.settings import parse_overrides, parse_value, updated, validated


class Inner(Parameters):
    radius_m: Annotated[float, Field(gt=0)] = 0.3
    rule: Literal["paper", "ours"] = "ours"


class Outer(Parameters):
    inner: Inner = Inner()
    count: int = 3


FIELDS = {"curvature_weighted": ["rule", "radius_m"], "statistical": ["multiplier"]}


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("0.5", 0.5),
        ("3", 3),
        ("true", True),
        ("[0, 2.5]", [0, 2.5]),
        ('"a"', "a"),
        ("paper", "paper"),
    ],
)
def test_values_are_read_as_toml_and_else_as_text(text, value):
    assert parse_value(text) == value


def test_overrides_are_grouped_by_filter_and_hyphens_do_not_matter():
    found = parse_overrides(
        [
            "curvature-weighted.rule=paper",
            "curvature_weighted.radius_m=0.2",
            "statistical.multiplier=3",
        ],
        FIELDS,
    )
    assert found == {
        "curvature_weighted": {"rule": "paper", "radius_m": 0.2},
        "statistical": {"multiplier": 3},
    }


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("curvature_weighted.rul=paper", "did you mean 'rule'"),
        ("curvature_weigted.rule=paper", "did you mean 'curvature_weighted'"),
        ("curvature_weighted=paper", "NAME.FIELD=VALUE"),
        ("rule", "NAME.FIELD=VALUE"),
    ],
)
def test_a_wrong_override_says_what_was_meant(text, said):
    with pytest.raises(InputError, match=said):
        parse_overrides([text], FIELDS)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"inner": {"radius_m": -1}}, r"p\.toml: inner\.radius_m, got -1: .*greater than 0"),
        ({"inner": {"radius": 1}}, r"'inner\.radius', did you mean 'radius_m'"),
        ({"inner": {"rule": "theirs"}}, r"inner\.rule, got 'theirs': .*'paper' or 'ours'"),
        ({"count": "many"}, r"count, got 'many': expected a valid integer"),
        ({"cuont": 3}, r"'cuont', did you mean 'count'"),
    ],
)
def test_validation_errors_name_place_field_value_and_what_was_expected(values, said):
    with pytest.raises(InputError, match=said) as caught:
        validated(Outer, values, "p.toml")
    assert "\n" not in str(caught.value)


def test_updating_keeps_what_was_set_before():
    model = updated(Inner(radius_m=0.7), {"rule": "paper"}, "inner")
    assert model == Inner(radius_m=0.7, rule="paper")
