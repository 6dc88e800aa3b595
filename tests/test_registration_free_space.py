"""What a scanner saw through: its place found again, and what it proves."""

import numpy as np
import pytest

from dougong.registration.free_space import find_place, free_space

BOXES = [
    ((-40, -40, -1), (40, 40, 0)),
    ((-8, -5, 0), (8, 5, 6)),
    ((14, -12, 0), (15, -3, 2)),
    ((-16, 8, 0), (-13, 11, 3)),
    ((3, -18, 0), (5, -16, 4)),
    ((-12, -14, 0), (-11, -9, 1.5)),
    *(((x, y, 0), (x + 0.5, y + 0.5, 3.5)) for x in (-20, -9, 9, 20) for y in (-22, -8, 7, 18)),
    *(((x, y, 0), (x + 5, y + 0.4, 1.2)) for x in (-28, -4, 18) for y in (-25, 14)),
]


def seen(place, seed=0, rays=40_000):
    """Return what a scanner at `place` sees of the boxes, 4 mm noise in range."""
    rng = np.random.default_rng(seed)
    away = rng.normal(size=(rays, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    best = np.full(rays, np.inf)
    for low, high in BOXES:
        with np.errstate(divide="ignore"):
            one, two = (np.asarray(low) - place) / away, (np.asarray(high) - place) / away
        enter = np.minimum(one, two).max(axis=1)
        leave = np.maximum(one, two).min(axis=1)
        hit = (enter < leave) & (enter > 0.1)
        best[hit] = np.minimum(best[hit], enter[hit])
    near = best < 60.0
    distance = best[near] + rng.normal(0, 0.004, near.sum())
    return place + away[near] * distance[:, None]


PLACES = [(0.0, -14.0, 1.7), (12.0, 9.0, 1.6), (-14.0, -2.0, 1.8)]


@pytest.mark.parametrize("place", PLACES)
def test_the_place_of_a_single_scan_is_found(place):
    found = find_place(seen(np.array(place)))
    assert found is not None
    assert np.linalg.norm((found - place)[:2]) < 1.5
    # Level ground has many ranges in one direction's cell and hides nothing: from 1.5 m too high
    # less of it seemed hidden.
    assert abs(found[2] - place[2]) < 0.5


def test_scans_from_several_places_have_no_one_place():
    assert (
        find_place(np.vstack([seen(np.array(place), k) for k, place in enumerate(PLACES)])) is None
    )


def test_a_single_wall_was_seen_from_anywhere():
    rng = np.random.default_rng(0)
    wall = np.column_stack([rng.uniform(0, 20, 5000), np.zeros(5000), rng.uniform(0, 6, 5000)])
    assert find_place(wall) is None


def test_what_stands_in_front_of_a_seen_surface_is_seen_through():
    place = np.array(PLACES[0])
    cloud = seen(place)
    free = free_space(cloud, np.tile(place, (len(cloud), 1)))
    front = cloud[(np.abs(cloud[:, 1] + 5.0) < 0.05) & (cloud[:, 2] > 1.0)]
    for share, through, visible in ((0.5, True, True), (1.0, False, True), (1.5, False, False)):
        is_through, is_visible = free.look(place + share * (front - place))
        assert np.mean(is_through == through) > 0.8
        assert np.mean(is_visible == visible) > 0.8


def test_two_scans_of_one_site_do_not_see_through_each_other():
    one, two = seen(np.array(PLACES[0]), 1), seen(np.array(PLACES[1]), 2)
    free = free_space(one, None)
    is_through, _ = free.look(two[two[:, 2] > 0.2])
    assert np.mean(is_through) < 0.01
    # In the mirror image garden walls stand where the first scanner saw none.
    same = seen(np.array(PLACES[0]), 3)
    mirrored = same * (-1.0, 1.0, 1.0)
    is_through, _ = free.look(mirrored[mirrored[:, 2] > 0.2])
    assert np.mean(is_through) > 0.05


def test_the_mirror_image_sees_through_the_mirrored_places():
    place = np.array(PLACES[0])
    cloud = seen(place)
    free = free_space(cloud, np.tile(place, (len(cloud), 1)))
    asked = np.random.default_rng(3).uniform((-20, -20, 0), (20, 20, 5), (2000, 3))
    assert np.array_equal(free.look(asked), free.mirrored().look(asked * (-1.0, 1.0, 1.0)))
