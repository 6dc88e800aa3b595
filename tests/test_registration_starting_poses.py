"""The pose that two clouds come with is heard beside those that are searched for."""

import numpy as np

from dougong.registration import Register, register
from registration_sites import SETTINGS, as_cloud, motion, moved, pose_error, site

QUICK = Register(prepare=SETTINGS)
MAP = np.array([5e5, 4e6, 120.0])


def test_clouds_delivered_nearly_in_one_system_start_there():
    """Half a metre and half a degree off, as a site's first setup is; at map coordinates."""
    truth = motion(0.5, (0.4, -0.3, 0.2))
    source = as_cloud(site("lidar", 3) + MAP)
    target = as_cloud(moved(site("photogrammetry", 4), truth) + MAP)
    found = register(source, target, QUICK.model_copy(update={"coarse": "pca"}))
    assert "delivered" in {h.method for h in found.hypotheses}
    assert found.status == "ok"
    shift = np.eye(4)
    shift[:3, 3] = MAP
    local = np.linalg.inv(shift) @ found.matrix @ shift
    assert max(pose_error(local, truth)) < 0.05


def test_a_delivered_pose_that_is_wrong_is_not_believed():
    """Turned half about a building that looks nearly the same from behind, in one system."""
    truth = motion(180.0, (0.0, 0.0, 0.0))
    source, target = site("lidar", 5), moved(site("photogrammetry", 6), truth)
    found = register(as_cloud(source), as_cloud(target), QUICK)
    assert found.status == "ok"
    assert max(pose_error(found.matrix, truth)) < 0.05
