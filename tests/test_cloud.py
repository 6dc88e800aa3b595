"""Clouds: selecting, packed attributes, moving between frames."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from dougong.cloud import BitField, Cloud, Frame, chosen_rows
from dougong.errors import InputError


def _turn(degrees, shift=(0.0, 0.0, 0.0)):
    a = np.radians(degrees)
    matrix = np.eye(4)
    matrix[:2, :2] = [[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]
    matrix[:3, 3] = shift
    return matrix


def test_points_at_map_coordinates_keep_their_digits():
    points = np.array([[500000.125, 4000000.25, 12.5], [500001.5, 4000003.75, 13.0]])
    cloud = Cloud.from_points(points, intensity=np.array([3, 4], "u2"))
    assert cloud.xyz.tolist() == [[0.125, 0.25, 0.5], [1.5, 3.75, 1.0]]
    assert np.array_equal(cloud.frame.to_file(cloud.xyz), points)
    assert cloud.attribute("intensity").tolist() == [3, 4]
    assert cloud.attribute("nothing") is None


def test_select_by_mask_and_by_index_agree_and_take_the_records_along():
    cloud = Cloud.from_points(np.arange(30.0).reshape(10, 3), tag=np.arange(10))
    mask = np.arange(10) % 3 == 0
    by_mask, by_index = cloud.select(mask), cloud.select(np.flatnonzero(mask))
    assert by_mask.attribute("tag").tolist() == [0, 3, 6, 9]
    assert np.array_equal(by_mask.xyz, by_index.xyz)
    assert np.array_equal(by_mask.records, by_index.records)


def test_rows_are_chosen_as_numpy_chooses_them():
    records = np.random.default_rng(0).integers(0, 256, (50, 13), dtype=np.uint8)
    records = records.reshape(-1).view([("a", "<f4"), ("b", "V3"), ("c", "<u2", (3,))])
    for chosen in (np.array([3, 3, -1, 0]), np.arange(50) % 2 == 0, np.arange(0)):
        assert chosen_rows(records, chosen).tobytes() == records[chosen].tobytes()
    with pytest.raises(InputError, match="one value per point, got 49 for 50"):
        chosen_rows(records, np.ones(49, dtype=bool))


def test_packed_attributes_are_set_without_touching_their_neighbours():
    records = np.array([(0b10100111,), (0b01011000,)], dtype=[("flags", "u1")])
    bits = {"low": BitField("flags", 0b111), "high": BitField("flags", 0b11000000, 6)}
    cloud = Cloud(xyz=np.zeros((2, 3)), records=records, frame=Frame(), bits=bits)
    assert cloud.attributes == ("low", "high")
    changed = cloud.with_attribute("low", np.array([1, 5]))
    assert changed.attribute("low").tolist() == [1, 5]
    assert changed.attribute("high").tolist() == cloud.attribute("high").tolist()
    assert (changed.records["flags"] & 0b111000).tolist() == [0b100000, 0b011000]
    assert cloud.attribute("low").tolist() == [7, 0], "the old cloud must not change"
    with pytest.raises(InputError, match=r"0\.\.7"):
        cloud.with_attribute("low", np.array([8, 0]))


@pytest.mark.parametrize(
    ("kind", "values", "said"),
    [
        ("u2", [70000, -1], "cannot hold 2 of 2 values (first: 70000 in row 0)"),
        ("u2", [1, 0.5], "cannot hold 1 of 2 values (first: 0.5 in row 1)"),
        ("u2", [1, np.nan], "stored as uint16"),
        ("u2", ["a", "b"], "stored as uint16"),
        ("f4", [1.0, 1e300], "stored as float32"),
        ("f8", [1, 2**53 + 1], "(first: 9007199254740993 in row 1)"),
        ("i8", np.array([1, 2**63], "u8"), "stored as int64"),
    ],
)
def test_a_value_that_its_attribute_cannot_hold_is_refused(kind, values, said):
    cloud = Cloud.from_points(np.zeros((2, 3)), intensity=np.array([3, 4], kind))
    with pytest.raises(InputError) as error:
        cloud.with_attribute("intensity", values)
    assert said in str(error.value)
    fits = cloud.with_attribute("intensity", np.array([1.0, 250.0]))
    assert fits.attribute("intensity").tolist() == [1, 250]
    assert fits.records.dtype == cloud.records.dtype


def test_what_is_set_has_the_shape_of_its_attribute():
    records = np.zeros(3, dtype=[("flags", "u1"), ("v", "f4", (2,)), ("q", "f4")])
    bits = {"low": BitField("flags", 0b111)}
    cloud = Cloud(xyz=np.zeros((3, 3)), records=records, frame=Frame(), bits=bits)
    vector = np.arange(6.0).reshape(3, 2)
    assert np.array_equal(cloud.with_attribute("v", vector).attribute("v"), vector)
    assert np.isnan(cloud.with_attribute("q", [1, np.nan, 2]).attribute("q")[1])
    for name, values in (("v", np.zeros(3)), ("q", 1.0), ("low", 1), ("new", vector)):
        with pytest.raises(InputError, match=f"{name} must have shape"):
            cloud.with_attribute(name, values)
    with pytest.raises(InputError, match="low is stored as uint8"):
        cloud.with_attribute("low", [0.5, 1, 2])


def test_a_cloud_is_built_of_one_value_per_point_at_places():
    points = np.eye(3)
    for values in (np.zeros(4), 5, np.zeros((3, 2))):
        with pytest.raises(InputError, match=r"tag must have shape \(3,\)"):
            Cloud.from_points(points, tag=values)
    with pytest.raises(InputError, match="x is a coordinate"):
        Cloud.from_points(points, x=np.zeros(3))
    with pytest.raises(InputError, match=r"1 of 3 rows .* beyond 9e\+09 \(first: row 1\)"):
        Cloud.from_points(np.diag([1.0, -3.4e38, 1.0]))


def test_moving_map_coordinates_loses_no_digit_to_the_offset():
    """A turn about a point 4000 km from zero must not cost a micrometre."""
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 50, (1000, 3)) + [500000, 4000000, 100]
    center = np.array([500025.0, 4000025.0, 100.0])
    matrix = _turn(37.0)
    matrix[:3, 3] = center - matrix[:3, :3] @ center + [1, 2, 3]
    moved = Cloud.from_points(points).moved(matrix)
    expected = (points - center) @ matrix[:3, :3].T + [1, 2, 3]
    assert moved.is_moved
    assert np.abs((moved.xyz + (moved.frame.origin - center)) - expected).max() < 1e-8


def test_moving_there_and_back_is_the_same_place():
    points = np.random.default_rng(1).uniform(-5, 5, (100, 3))
    cloud = Cloud.from_points(points)
    matrix = _turn(77.0, (10.0, -3.0, 2.0))
    back = cloud.moved(matrix).moved(np.linalg.inv(matrix), cloud.frame)
    assert np.abs(back.xyz - cloud.xyz).max() < 1e-12


def test_moving_from_feet_into_metres():
    frame = Frame(unit_m=(0.3048,) * 3, step=(0.01,) * 3)
    cloud = Cloud(
        xyz=np.array([[0.3048, 0.6096, 3.048]]),
        records=np.zeros(1, dtype=[("a", "u1")]),
        frame=frame,
    )
    to_metres = np.diag([0.3048, 0.3048, 0.3048, 1.0])
    moved = cloud.moved(to_metres, Frame())
    assert np.abs(moved.xyz - cloud.xyz).max() < 1e-15
    assert moved.frame.step == pytest.approx((0.003048,) * 3)


def test_the_step_of_a_moved_cloud_is_the_finest_of_its_axes():
    cloud = Cloud(
        xyz=np.zeros((1, 3)),
        records=np.zeros(1, dtype=[("a", "u1")]),
        frame=Frame(step=(0.01, 0.01, 0.001)),
    )
    assert cloud.moved(_turn(45.0), Frame()).frame.step == (0.001, 0.001, 0.001)


@pytest.mark.parametrize(
    "axes", [("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"), ("x_t", "y_t", "z_t")]
)
def test_normals_turn_with_the_points(axes):
    normals = {
        axis: np.array(v, "f4") for axis, v in zip(axes, ([1, 0], [0, 0], [0, 1]), strict=True)
    }
    cloud = Cloud.from_points(np.zeros((2, 3)), other=np.array([7, 8]), **normals)
    doubled = _turn(90.0) @ np.diag([2.0, 2.0, 2.0, 1.0])
    moved = cloud.moved(doubled)
    found = np.stack([moved.attribute(axis) for axis in axes], axis=1)
    assert np.abs(found - [[0, 1, 0], [0, 0, 1]]).max() < 1e-6
    assert moved.attribute("other").tolist() == [7, 8]
    assert cloud.attribute(axes[0]).tolist() == [1, 0], "the old cloud must not change"


def test_rebased_points_are_in_the_same_place():
    cloud = Cloud.from_points(np.array([[1.5, 2.5, 3.5]]))
    other = cloud.rebased(np.array([10.0, 20.0, 30.0]))
    assert np.array_equal(other.frame.to_file(other.xyz), cloud.frame.to_file(cloud.xyz))


@pytest.mark.parametrize("factors", [3.0, np.array([-1.0, 1.0, 2.0])])
def test_the_scanner_stays_where_it_stood_in_a_stretched_cloud(factors):
    """Its place was left behind: free space was cast from elsewhere."""
    cloud = replace(Cloud.from_points(np.eye(3)), viewpoints=np.array([[8.0, 6.0, 2.6]]))
    other = cloud.stretched(factors, cloud.frame)
    assert np.array_equal(other.xyz, cloud.xyz * factors)
    assert np.array_equal(other.viewpoints, np.array([[8.0, 6.0, 2.6]]) * factors)


def test_a_mirror_is_refused():
    with pytest.raises(InputError, match="mirrors"):
        Cloud.from_points(np.zeros((1, 3))).moved(np.diag([1, 1, -1, 1.0]))


def test_a_cloud_goes_to_another_process_whole():
    cloud = Cloud.from_points(np.arange(12.0).reshape(4, 3) + [5e5, 4e6, 0.0])
    again = pickle.loads(pickle.dumps(cloud))
    np.testing.assert_array_equal(again.xyz, cloud.xyz)
    np.testing.assert_array_equal(again.frame.to_file(again.xyz), cloud.frame.to_file(cloud.xyz))
