"""Clouds of a project that have no unit: their scale first, then their filters, in metres."""

import json

import numpy as np
import pytest

import dougong
from dougong.cli import call
from dougong.cloud import Cloud
from dougong.pipeline.pairs import HEADER
from registration_sites import motion, moved, rectangle, site

UNIT = 0.37
PLACES = np.array(
    [[-9, -6, 1], [12, -6, 2], [12, 2, 4], [-2, 9, 3], [18, 10, 1], [-20, -18, 0.5], [5, 5, 3.0]]
)
MOVED = motion(130, (40, -20, 3), 0.3)
"""Drone to scan, metres."""


def project(folder, more=""):
    path = folder / "project.toml"
    path.write_text(
        '[[cloud]]\nname="scan"\nkind="lidar"\nfiles=["scan.laz"]\n'
        '[[cloud]]\nname="drone"\nkind="photogrammetry"\nfiles=["drone.ply"]\n'
        f"scale_known=false\n{more}"
    )
    return path


def run(capsys, path, out):
    code = call(["run", str(path), "--out", str(out), "--json", "--quiet"])
    return code, json.loads(capsys.readouterr().out)


def control_file(folder, spoilt=0.0):
    source, rows = PLACES / UNIT, [",".join(HEADER)]
    target = moved(PLACES, MOVED)
    target[0] += spoilt
    for k, (one, other) in enumerate(zip(source, target, strict=True)):
        at = ",".join(f"{v:.6f}" for v in (*one, *other))
        rows.append(f"P{k},drone,{at},0.004,{'check' if k > 4 else 'control'}")
    (folder / "control.csv").write_text("\n".join(rows) + "\n")


@pytest.fixture
def folder(tmp_path):
    drone = site("photogrammetry", 1, per_m2=40.0)
    dougong.write(Cloud.from_points(drone / UNIT), tmp_path / "drone.ply")
    scan = moved(site("lidar", 0, size=20, per_m2=40.0), MOVED)
    dougong.write(Cloud.from_points(scan), tmp_path / "scan.laz")
    return tmp_path


def test_a_cloud_without_a_unit_goes_through_the_whole_run(folder, tmp_path, capsys):
    control_file(folder)
    path = project(folder, '[quality]\ncontrol="control.csv"\n')
    code, result = run(capsys, path, tmp_path / "out")
    (link,) = result["registrations"]
    assert (code, link["status"], result["reference"]) == (0, "ok", "scan"), link["reason"]
    search = link["scale_search"]
    assert search["control_points"] == 5
    assert abs(search["metres_per_unit"] / UNIT - 1) < max(3e-4, 2 * search["sigma_ln"])
    assert (link["dof"], np.shape(link["covariance"])) == (7, (7, 7))
    # Residuals of the check points are metres, though the drone's file is not.
    assert link["checks"]["check"]["check_rmse_m"] < 0.02
    assert "one unit of drone is 0.3" in link["reason"]
    assert not any("taken as metres" in note and "drone" in note for note in result["notes"])
    # The filters had metres: nearly nothing of a clean cloud is taken for noise.
    drone = next(cloud for cloud in result["clouds"] if cloud["name"] == "drone")
    assert (drone["scale_known"], drone["reduction"] < 0.05) == (False, True)
    placed = dougong.read(tmp_path / "out" / "clouds" / "drone.laz")
    there = moved(site("photogrammetry", 1, per_m2=40.0), MOVED)
    middle = placed.frame.to_file(np.median(placed.xyz, axis=0)[None])[0]
    np.testing.assert_allclose(middle, np.median(there, axis=0), atol=0.1)


def test_one_bad_control_point_is_named_and_does_not_make_the_scale(folder, tmp_path, capsys):
    control_file(folder, spoilt=2.5)
    path = project(folder, '[quality]\ncontrol="control.csv"\n')
    code, result = run(capsys, path, tmp_path / "out")
    (link,) = result["registrations"]
    assert (code, link["checks"]["bad"]) == (0, ["P0"]), link["reason"]
    assert abs(link["scale_search"]["metres_per_unit"] / UNIT - 1) < 3e-4


def test_where_no_scale_is_found_the_cloud_stays_as_it_is(tmp_path, capsys):
    def wall(seed, width):
        rng = np.random.default_rng(seed)
        points = rectangle(rng, [0, 0, 0], [width, 0, 0], [0, 0, 4], 60.0)
        return points + rng.normal(0, 0.004, points.shape)

    scan, drone = wall(0, 12), wall(1, 14)
    dougong.write(Cloud.from_points(scan), tmp_path / "scan.laz")
    dougong.write(Cloud.from_points(drone / UNIT), tmp_path / "drone.ply")
    code, result = run(capsys, project(tmp_path), tmp_path / "out")
    (link,) = result["registrations"]
    assert (code, link["status"], link["matrix"]) == (3, "failed", None)
    assert result["merged"]["clouds"] == ["scan"]
    kept = dougong.read(tmp_path / "out" / "clouds" / "drone.laz")
    assert len(kept) == len(drone)
    np.testing.assert_allclose(np.ptp(kept.xyz, axis=0), np.ptp(drone / UNIT, axis=0), atol=1e-3)
    assert any("not filtered, since its scale is not known" in note for note in result["notes"])
