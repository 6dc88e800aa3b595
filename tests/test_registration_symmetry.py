"""What equal poses have in common, in words: folds, roundness, slides, heights."""

import numpy as np
import pytest

from dougong.registration.symmetry import folds, in_words, move_between

MIDDLE = np.array([3.0, -2.0, 1.0])
CENTRE = np.array([10.0, 4.0, 0.0])


def turned(deg, about=CENTRE, shift=(0.0, 0.0, 0.0)):
    """Return the pose that turns about a place in the target and then shifts."""
    c, s = np.cos(np.radians(deg)), np.sin(np.radians(deg))
    T = np.eye(4)
    T[:2, :2] = [[c, -s], [s, c]]
    T[:3, 3] = about - T[:3, :3] @ about + np.asarray(shift)
    return T


def words(*poses):
    return in_words([move_between(np.eye(4), T, MIDDLE) for T in poses])


@pytest.mark.parametrize("n", range(2, 13))
def test_folds_are_counted_from_some_of_the_turns(n):
    step = 360.0 / n
    assert folds([step, -step + 0.5]) == n
    assert folds([step * k + 0.5 * (-1) ** k for k in range(1, n)]) == n


def test_turns_on_no_grid_have_no_folds():
    assert folds([17.0, 100.0, -61.0]) == 0


def test_an_octagon_is_named_with_all_its_poses():
    said = words(*(turned(45.0 * k) for k in range(1, 8)))
    assert "repeats every 45 degrees" in said
    assert "8 poses fit alike, all of them found" in said
    assert "A yaw hint, control points or more of the site around would decide" in said


def test_an_octagon_found_in_part_says_so():
    said = words(turned(45.0), turned(180.0))
    assert "8 poses fit alike, 3 of them found" in said


def test_a_turn_keeps_its_centre_wherever_the_middle_is():
    move = move_between(np.eye(4), turned(90.0), MIDDLE)
    np.testing.assert_allclose(move.centre, CENTRE[:2], atol=1e-9)
    assert move.turn_deg == pytest.approx(90.0)


def test_a_small_turn_is_no_shift():
    """A pose 0.4 degrees off was 'shifted by +0.01 m'."""
    said = words(turned(0.4, about=MIDDLE, shift=(0.01, 0.0, 0.0)))
    assert "turned by only +0.4 deg about the middle" in said
    assert "shifted" not in said


def test_a_ring_is_round():
    assert "is round" in words(turned(17.0), turned(100.0), turned(-61.0))


def test_turns_about_different_places_are_no_symmetry():
    said = words(turned(90.0), turned(180.0, about=CENTRE + [9.0, 0.0, 0.0]))
    assert "repeats" not in said
    assert "about different places" in said


def test_a_slide_is_named_by_its_direction_and_lengths():
    way = np.array([np.cos(0.5), np.sin(0.5), 0.0])
    said = words(turned(0.0, shift=2.0 * way), turned(0.0, shift=-4.0 * way))
    assert "+2.00 m" in said or "-2.00 m" in said
    assert "along 29 deg from +x towards +y" in said
    assert "yaw hint" not in said


def test_two_heights_are_told_as_heights():
    said = words(turned(0.0, shift=(0.01, 0.0, 0.24)))
    assert "in height they differ by +0.24 m" in said
    assert "scanner's position" in said
