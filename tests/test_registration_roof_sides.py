"""A roof seen from one side by the scanner and from the other by the drone."""

import numpy as np

from dougong.registration import Register, register
from dougong.registration.evidence import summon
from dougong.registration.prepare import Prepare, prepare
from dougong.registration.roof_sides import (
    ground_says,
)
from registration_sites import (
    L_PLAN,
    SETTINGS,
    _inside,
    as_cloud,
    local_truth,
    motion,
    moved,
    pose_error,
    rectangle,
    site,
)

THICKNESS_M = 0.25
TRUTH = motion(37.0, (5.0, -3.0, 1.5))


def with_soffit(seed):
    """Return a scan with the soffit over a gallery inside the walls, its floor out of sight."""
    rng = np.random.default_rng([seed, 1])
    soffit = rectangle(rng, [-10, -6, 5.0 - THICKNESS_M], [22, 0, 0], [0, 15, 0], 40.0)
    is_gallery = ~_inside(soffit[:, :2] + (0.8, 0.0), 0.8 * np.asarray(L_PLAN, float))
    soffit = soffit[_inside(soffit[:, :2], L_PLAN) & is_gallery]
    return np.vstack([site("lidar", seed), soffit + rng.normal(0, 0.003, soffit.shape)])


def flown(seed, *, has_ground):
    points = site("photogrammetry", seed + 100)
    return moved(points if has_ground else points[points[:, 2] > 0.3], TRUTH)


def registered(source, target):
    source, target = as_cloud(source), as_cloud(target)
    found = register(source, target, Register(prepare=SETTINGS))
    return found, pose_error(found.matrix, TRUTH) if found.matrix is not None else None


def test_a_soffit_is_not_taken_for_the_roof_above_it():
    """Without ground in the flight only the roof speaks of the height, and it may be either."""
    found, _ = registered(with_soffit(0), flown(0, has_ground=False))
    assert found.status == "ambiguous"
    assert "from above or from below" in found.reason or "roof's top and its un" in found.reason


def battered(seed, kind):
    """Return the faces of a plinth and of a bastion, leaning 30 degrees: they hold a height."""
    rng = np.random.default_rng([seed, 2])
    noise = 0.003 if kind == "lidar" else 0.012
    faces = [
        rectangle(rng, [-26, y, 0.4], [9, 0, 0], [0, lean, 2.4], 40.0)
        for y, lean in ((-12, 1.4), (14, -1.4))
    ]
    faces += [
        rectangle(rng, [x, -10, 0.4], [0, 8, 0], [lean, 0, 2.4], 40.0)
        for x, lean in ((24, -1.4), (-29, 1.4))
    ]
    points = np.vstack(faces)
    return points + rng.normal(0, noise, points.shape)


def test_what_is_no_roof_holds_the_height_where_it_can():
    """With the soffit taken for the roof the pose was a roof's thickness too high."""
    source = np.vstack([with_soffit(0), battered(0, "lidar")])
    flight = np.vstack([flown(0, has_ground=False), moved(battered(1, "photogrammetry"), TRUTH)])
    found, error = registered(source, flight)
    assert found.status == "ok", found.reason
    assert error[2] < 0.03


def test_ground_in_both_clouds_holds_the_height():
    found, error = registered(with_soffit(0), flown(0, has_ground=True))
    assert found.status == "ok"
    assert error[2] < 0.03


def test_thin_clouds_with_ground_are_decided_by_the_ground():
    """Points as far apart as a roof is thick: nothing else prefers one height by enough."""
    clouds = as_cloud(site("lidar", 0)), as_cloud(flown(0, has_ground=True))
    source = prepare(clouds[0], "lidar", Prepare(min_spacing_m=0.4))
    target = prepare(clouds[1], "photogrammetry", Prepare(min_spacing_m=0.4))
    T = local_truth(TRUTH, *clouds)
    court = summon(source, target)
    assert ground_says(court, source, target, T) == "agrees"
    T[2, 3] += THICKNESS_M
    assert ground_says(court, source, target, T) == "differs"


def test_ground_that_differs_by_a_roof_is_no_proof():
    clouds = as_cloud(with_soffit(0)), as_cloud(flown(0, has_ground=True))
    source = prepare(clouds[0], "lidar", SETTINGS)
    target = prepare(clouds[1], "photogrammetry", SETTINGS)
    T = local_truth(TRUTH, *clouds)
    assert ground_says(summon(source, target), source, target, T) == "agrees"
    for height in (0.15, -0.25):
        raised = T.copy()
        raised[2, 3] += height
        assert ground_says(summon(source, target), source, target, raised) == "differs"
