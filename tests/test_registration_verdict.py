"""The proof: what cannot be told apart is said, and a wrong pose is never called ok."""

from dataclasses import fields, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dougong.registration.decision import decide
from dougong.registration.evidence import hear, sharpness, summon, support
from dougong.registration.handedness import _mirrored_witness, handedness
from dougong.registration.icp import Icp, build_levels
from dougong.registration.prepare import Prepared
from dougong.registration.result import Hypothesis
from dougong.registration.rivals import is_same
from dougong.registration.sanity import mirrored
from dougong.registration.settings import Register
from dougong.registration.surface import surface
from dougong.registration.verdict import Comparison, Verdict, compare, is_beaten

SPACING = 0.25


def rectangle(rng, corner, u, v, normal):
    """Points of a parallelogram, one per SPACING squared."""
    u, v = np.array(u, dtype=float), np.array(v, dtype=float)
    count = int(np.linalg.norm(np.cross(u, v)) / SPACING**2)
    at = np.array(corner) + rng.random((count, 1)) * u + rng.random((count, 1)) * v
    return at, np.tile(normal, (count, 1)).astype(float)


def house(rng, x, y, length, width, height):
    """Four walls and a flat roof."""
    a, b = x + length, y + width
    return [
        rectangle(rng, (x, y, 0), (length, 0, 0), (0, 0, height), (0, -1, 0)),
        rectangle(rng, (x, b, 0), (length, 0, 0), (0, 0, height), (0, 1, 0)),
        rectangle(rng, (x, y, 0), (0, width, 0), (0, 0, height), (-1, 0, 0)),
        rectangle(rng, (a, y, 0), (0, width, 0), (0, 0, height), (1, 0, 0)),
        rectangle(rng, (x, y, height), (length, 0, 0), (0, width, 0), (0, 0, 1)),
    ]


def site(seed, *houses, sigma=0.005, kind="lidar"):
    rng = np.random.default_rng(seed)
    parts = [rectangle(rng, (-25, -25, 0), (50, 0, 0), (0, 50, 0), (0, 0, 1))]
    for numbers in houses:
        parts += house(rng, *numbers)
    xyz = np.concatenate([p for p, _ in parts]) + sigma * rng.normal(
        size=(sum(len(p) for p, _ in parts), 3)
    )
    normals = np.concatenate([n for _, n in parts])
    return Prepared(
        xyz=xyz,
        normals=normals,
        normal_is_oriented=False,
        planarity=np.full(len(xyz), 0.99),
        is_ground=np.arange(len(xyz)) < len(parts[0][0]),
        height_above_ground=xyz[:, 2],
        weights_area=np.full(len(xyz), SPACING**2),
        spacing_m=SPACING,
        sigma_m=sigma,
        kind=kind,
    )


def turned(deg, shift=(0.0, 0.0, 0.0)):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", deg, degrees=True).as_matrix()
    T[:3, 3] = shift
    return T


def part(cloud, is_in):
    """The chosen points of a prepared cloud."""
    columns = {
        field.name: value[is_in]
        for field in fields(cloud)
        if isinstance(value := getattr(cloud, field.name), np.ndarray) and len(value) == len(is_in)
    }
    return replace(cloud, **columns)


def starts(*poses):
    return [Hypothesis(T_target_source=T, score=0.5, method="given") for T in poses]


SYMMETRIC = ((-6.0, -4.0, 12.0, 8.0, 5.0),)
UNLIKE = ((-6.0, -4.0, 12.0, 8.0, 5.0), (10.0, 6.0, 5.0, 4.0, 3.0), (-18.0, 8.0, 4.0, 9.0, 6.0))


def test_a_site_that_is_unlike_itself_is_ok_and_right():
    found = decide(
        site(0, *UNLIKE),
        site(1, *UNLIKE),
        starts(turned(180.0), turned(1.0, (0.2, -0.1, 0.1))),
        Register(),
    )
    assert found.status == "ok"
    assert is_same(found.T, np.eye(4), np.zeros(3))
    assert np.linalg.norm(found.T[:3, 3]) < 0.01
    assert found.probability > 0.9


def test_a_lone_symmetric_house_is_ambiguous_though_one_start_was_given():
    found = decide(site(2, *SYMMETRIC), site(3, *SYMMETRIC), starts(turned(0.5)), Register())
    assert found.status == "ambiguous"
    listed = [found.T, *(c.T for c in found.ruling.undecided)]
    for angle in (0.0, 180.0):
        assert any(is_same(T, turned(angle), np.zeros(3)) for T in listed)
    assert found.probability <= 0.5
    assert "yaw hint" in found.reason


def test_a_hint_between_two_equal_poses_is_not_advised_again():
    found = decide(
        site(2, *SYMMETRIC), site(3, *SYMMETRIC), starts(turned(0.5)), Register(yaw_hint_deg=90.0)
    )
    assert found.status == "ambiguous"
    assert "the hint says 90" in found.reason
    assert "A yaw hint" not in found.reason


def test_a_yaw_hint_decides_a_symmetric_house():
    found = decide(
        site(2, *SYMMETRIC), site(3, *SYMMETRIC), starts(turned(0.5)), Register(yaw_hint_deg=0.0)
    )
    assert found.status == "ok"


def test_a_hint_that_nothing_fits_near_is_not_passed_over():
    """The only pose heard was 100 degrees from the hint, and came out as if there were none."""
    found = decide(
        site(4, *UNLIKE), site(5, *UNLIKE), starts(turned(0.5)), Register(yaw_hint_deg=100.0)
    )
    assert found.status == "ambiguous"
    assert "fit at a yaw of 0 deg, and the hint says 100" in found.reason


def test_two_different_places_are_never_ok():
    other = ((-10.0, -12.0, 5.0, 14.0, 7.0), (4.0, -3.0, 9.0, 3.0, 4.0))
    poses = [turned(angle, (0.3, 0.2, 0.0)) for angle in (0, 45, 90, 180, 270)]
    found = decide(site(4, *UNLIKE), site(5, *other), starts(*poses), Register())
    assert found.status != "ok"


def test_a_lone_wall_slides():
    wall = ((-20.0, 0.0, 40.0, 0.3, 4.0),)

    # The ends of the wall, which would stop it, are cut off.
    def cut(cloud):
        keep = np.abs(cloud.xyz[:, 0]) < 15.0
        return Prepared(
            xyz=cloud.xyz[keep],
            normals=cloud.normals[keep],
            normal_is_oriented=False,
            planarity=cloud.planarity[keep],
            is_ground=cloud.is_ground[keep],
            height_above_ground=cloud.height_above_ground[keep],
            weights_area=cloud.weights_area[keep],
            spacing_m=SPACING,
            sigma_m=cloud.sigma_m,
            kind="lidar",
        )

    found = decide(cut(site(6, *wall)), cut(site(7, *wall)), starts(np.eye(4)), Register())
    assert found.status != "ok"


def test_no_start_is_a_failure_in_words():
    found = decide(site(8, *UNLIKE), site(9, *UNLIKE), [], Register())
    assert found.status == "failed"
    assert found.T is None
    assert "found no pose" in found.reason


def test_comparison_is_antisymmetric_and_prefers_the_truth():
    court = summon(site(10, *UNLIKE), site(11, *UNLIKE))
    right, wrong = hear(court, np.eye(4)), hear(court, turned(180.0))
    forward = compare(court, right, wrong, 5.0)
    assert forward.gain > 0.1
    assert forward.p_value < 1e-2
    assert compare(court, wrong, right, 5.0).gain == pytest.approx(-forward.gain)
    assert compare(court, right, right, 5.0).p_value == 1.0


def test_only_the_true_pose_is_sharp():
    court = summon(site(12, *UNLIKE), site(13, *UNLIKE))
    right, wrong = hear(court, np.eye(4)), hear(court, turned(40.0, (3.0, 0.0, 1.7)))
    assert sharpness(court, right) > 2.0 > sharpness(court, wrong)
    assert support(court, right) > 0.95
    assert right.total < wrong.total


# A house and its wing equal their mirror image; the barn beside them does not.
HOUSE = ((-6.0, -4.0, 12.0, 8.0, 5.0), (-3.0, -15.0, 6.0, 11.0, 4.0))
BARN = (10.0, 3.0, 8.0, 6.0, 5.0)


@pytest.mark.parametrize("has_barn", [True, False])
def test_the_mirror_image_of_a_symmetric_house_is_heard(has_barn):
    houses = (*HOUSE, BARN) if has_barn else HOUSE
    source, target = site(8, *houses), site(9, *houses)
    plain = decide(source, target, starts(turned(0.5)), Register())
    assert plain.status == "ok", plain.reason
    assert np.linalg.norm(plain.T[:3, 3]) < 0.01
    assert ("mirror image fits as well" in plain.reason) is not has_barn
    left = mirrored(source)
    if not has_barn:
        assert (
            "mirror image fits as well"
            in decide(left, target, starts(turned(0.5)), Register()).reason
        )
        return
    # The house alone would carry the pose; what its mirror image explains as well gives it away.
    icp = Icp(levels=2, first_distance_m=1.5, last_distance_m=0.5, points_per_level=3000)
    court, levels = summon(left, target), build_levels(left, target, icp)
    winner = hear(court, np.eye(4))
    assert handedness(court, levels, winner, icp, Register().verdict) == "left"


# Two wings with their outhouses, each the other's mirror image, and a corridor between them.
WINGS = (
    (-16.0, -6.0, 8.0, 12.0, 5.0),
    (8.0, -6.0, 8.0, 12.0, 5.0),
    (-8.0, 2.0, 16.0, 4.0, 4.0),
    (-14.0, -12.0, 4.0, 6.0, 4.0),
    (10.0, -12.0, 4.0, 6.0, 4.0),
)


def test_a_wing_that_mirrors_the_other_makes_no_file_left_handed():
    one, two = site(20, *WINGS), site(21, *WINGS)
    source, target = part(one, one.xyz[:, 0] < 5.0), part(two, two.xyz[:, 0] > -5.0)
    icp = Icp(levels=2, first_distance_m=1.5, last_distance_m=0.5, points_per_level=3000)
    court, levels = summon(source, target), build_levels(source, target, icp)
    winner = hear(court, np.eye(4))
    assert handedness(court, levels, winner, icp, Register().verdict) == "open"


def test_a_mirrored_witness_is_heard_as_the_witness_is():
    cloud = site(8, *HOUSE, BARN)
    court = summon(cloud, cloud)
    mirror_image = replace(
        court,
        source=_mirrored_witness(court.source),
        target=_mirrored_witness(court.target),
    )
    pose = turned(20.0, (1.0, 2.0, 0.0))
    plain, other = hear(court, pose), hear(mirror_image, turned(-20.0, (-1.0, 2.0, 0.0)))
    # A point on the border of a cell may fall to either side.
    assert np.mean(plain.is_within != other.is_within) < 1e-3
    assert np.mean(plain.is_inside != other.is_inside) < 1e-3
    assert plain.total == pytest.approx(other.total, abs=1e-3)


def test_a_larger_difference_may_be_less_rare():
    def comparison(gain, p_value):
        return Comparison(T=np.eye(4), gain=gain, p_value=p_value, blocks=9)

    params = Verdict(p_value=1e-3, gain=0.05)
    assert not is_beaten(comparison(0.049, 1e-9), params)
    assert is_beaten(comparison(0.05, 1e-3), params)
    assert not is_beaten(comparison(0.05, 1.1e-3), params)
    assert is_beaten(comparison(0.1, 3.1e-3), params)
    assert not is_beaten(comparison(0.1, 3.2e-3), params)
    assert is_beaten(comparison(0.3, 1e-2), params)
    assert not is_beaten(comparison(0.3, 1.1e-2), params)


def test_blocks_that_disagree_about_the_pose_are_not_ok():
    strict = Register(verdict=Verdict(most_spread_m=0.001))
    found = decide(site(8, *UNLIKE), site(9, *UNLIKE), starts(turned(0.5)), strict)
    assert found.status == "ambiguous"
    assert "disagree about the pose" in found.reason


def test_what_the_proof_refuses_is_not_fitted():
    other = ((-10.0, -12.0, 5.0, 14.0, 7.0), (4.0, -3.0, 9.0, 3.0, 4.0))
    found = decide(site(4, *UNLIKE), site(5, *other), starts(turned(30.0)), Register())
    assert found.status == "failed"
    assert found.fine is None


def test_too_little_overlap_is_refused_unless_asked():
    pair = site(8, *UNLIKE), site(9, *UNLIKE)
    asked = Register(verdict=Verdict(least_overlap=0.9))
    assert decide(*pair, starts(turned(0.5)), asked).status == "ok"
    strict = Register(verdict=Verdict(least_overlap=1.0))
    found = decide(*pair, starts(turned(0.5)), strict)
    assert found.status == "failed"
    assert "at least 100 % expected" in found.reason
    assert "least_overlap" in found.reason


@pytest.mark.parametrize("seed", range(3))
def test_a_crown_beside_a_dense_wall_is_no_surface_that_goes_on(seed):
    rng = np.random.default_rng(seed)
    wall = rng.uniform([0, -0.01, 0], [12, 0.01, 6], (15_000, 3))
    way = rng.normal(size=(600, 3))
    leaves = way * (rng.normal(2.0, 0.15, 600) / np.linalg.norm(way, axis=1))[:, None]
    xyz = np.vstack([wall, leaves + [6, 8, 6]])
    plane = surface(xyz, 16)
    cloud = Prepared(
        xyz=xyz,
        normals=plane.normals,
        normal_is_oriented=False,
        planarity=plane.planarity,
        is_ground=np.zeros(len(xyz), bool),
        height_above_ground=xyz[:, 2],
        weights_area=plane.area_m2,
        spacing_m=plane.spacing_m,
        sigma_m=0.003,
        kind="lidar",
    )
    witness = summon(cloud, cloud).source
    is_leaf = witness.points[:, 1] > 3.0
    assert witness.is_firm[~is_leaf].mean() > 0.99
    # Nearest planes alone called 6 to 9 % of these leaves firm.
    assert (witness.is_firm & witness.is_structure)[is_leaf].mean() < 0.01
