"""The generated sites with clutter, and the tables of what was taken for what."""

import numpy as np
import pytest

from dougong.evaluation.clutter_site import clutter_site
from dougong.evaluation.clutter_things import PERSON, THINGS, WIRE
from dougong.evaluation.clutter_trials import point_table, summary, thing_table, trial
from dougong.filters import clutter
from dougong.formats import read


def test_a_site_knows_what_every_point_lies_on():
    site = clutter_site("wall", 7, 60_000)
    again = clutter_site("wall", 7, 60_000)
    np.testing.assert_array_equal(site.points, again.points)
    is_thing = np.isin(site.labels, list(THINGS))
    np.testing.assert_array_equal(site.things >= 0, is_thing)
    assert {PERSON, WIRE} <= set(site.labels.tolist())
    for number in np.unique(site.things[is_thing]):
        assert len(np.unique(site.labels[site.things == number])) == 1


def test_the_tables_add_up():
    rows = trial("wall", 7, 150_000)
    things = {line["thing"]: line for line in thing_table(rows)}
    kinds = ("none", "person", "vehicle", "pole", "wire")
    assert all(line["n"] == sum(line[kind] for kind in kinds) for line in things.values())
    points = {line["points on"]: line for line in point_table(rows)}
    assert points["building"]["none"] > 0.9999 * points["building"]["n"]
    table = {line["kind"]: line for line in summary(rows)}
    assert table["wire"]["n"] is None
    share = 100 * points["vehicle"]["vehicle"] / points["vehicle"]["n"]
    assert table["vehicle"]["point recall %"] == pytest.approx(share)


@pytest.mark.data
@pytest.mark.parametrize("tall", [1.2, 1.7, 3.0])
def test_the_stone_lion_is_no_clutter_at_any_size(data, tall):
    points = read(data / "lion_takanawa" / "lion_takanawa.copc.laz").xyz[::4]
    points = (points - points.min(axis=0)) * (tall / np.ptp(points[:, 2]))
    up = points[points[:, 2] > 0.09]
    found = clutter(up, height_above_ground=up[:, 2])
    assert not found.attributes["clutter_kind"].any()
