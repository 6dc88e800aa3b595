"""The simulated surveys: truth, labels, occlusion, noise, determinism."""

import functools
import hashlib

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from dougong import threads
from dougong.errors import InputError
from dougong.evaluation import scenes, survey
from dougong.evaluation.drone import Drone, draw_bending
from dougong.evaluation.mesh import MIXED, NEAR_NOISE, OUTLIER, Mesh, Tracer
from dougong.evaluation.metrics import displacements, pose_errors
from dougong.evaluation.scanner import Scanner, scan
from dougong.evaluation.solids import box, join

KINDS = sorted(scenes.BUILDERS)
CLEAN_SCANNER = Scanner(range_noise_m=0, angle_noise_deg=0, mixed_share=0)
CLEAN_DRONE = Drone(noise_m=0)


@pytest.fixture(scope="module")
def clean():
    """Return scenes without noise, bending or outliers, made once."""
    made = {}

    def get(kind):
        if kind not in made:
            made[kind] = scenes.make_scene(
                kind,
                1,
                lidar_points=25_000,
                photogrammetry_points=20_000,
                bending=False,
                outliers=0.0,
                scanner=CLEAN_SCANNER,
                drone=CLEAN_DRONE,
            )
        return made[kind]

    return get


@pytest.fixture(scope="module")
def noisy():
    return scenes.make_scene("hall", 5, lidar_points=60_000, photogrammetry_points=40_000)


@functools.cache
def world_of(kind, seed):
    return scenes._world(kind, seed, True)


def site_points(scene, cloud, which):
    """Return a cloud in site coordinates, by the poses drawn for the scene."""
    world, _ = world_of(scene.name, scene.seed)
    poses = survey.draw_poses(world, survey.stream(scene.seed, f"{scene.name} pose"), 0.6)
    T = poses[which]
    file = cloud.frame.to_file(cloud.xyz)
    return world, (file - T[:3, 3]) @ T[:3, :3]


def digest(scene):
    hashed = hashlib.sha256()
    for cloud in (scene.lidar, scene.photogrammetry):
        hashed.update(cloud.records.tobytes())
    hashed.update(scene.truth.T_best.tobytes() + scene.truth.surface_bent.tobytes())
    return hashed.hexdigest()


@pytest.mark.parametrize("kind", KINDS)
def test_clean_lidar_points_lie_where_the_beam_first_meets_the_mesh(clean, kind):
    scene = clean(kind)
    world, points = site_points(scene, scene.lidar, 0)
    tracer = world_of(kind, 1)[1].together_with(world.during_scan)
    sight = points - world.stations[scene.lidar.attribute("station")]
    distance = np.linalg.norm(sight, axis=1)
    found, face = tracer.cast(points - sight, sight / distance[:, None])
    np.testing.assert_allclose(found, distance, atol=1e-6)
    assert (tracer.mesh.labels[face] == scene.lidar.attribute("truth_label")).mean() > 0.999


@pytest.mark.parametrize("kind", KINDS)
def test_clean_drone_points_lie_on_the_mesh_moved_by_the_truth(clean, kind):
    scene = clean(kind)
    world, points = site_points(scene, scene.photogrammetry, 1)
    tracer = world_of(kind, 1)[1].together_with(world.during_flight)
    on = np.zeros(len(points), dtype=bool)
    for axis in np.vstack([np.eye(3), np.ones((1, 3)) / np.sqrt(3)]):
        distance, _ = tracer.cast(points - 0.002 * axis, np.broadcast_to(axis, points.shape), 0.01)
        on |= np.abs(distance - 0.002) < 1e-6
    assert on.mean() > 0.999
    # The truth is the chain of the two poses.
    lidar_site, map_site = survey.draw_poses(world, survey.stream(scene.seed, f"{kind} pose"), 0.6)
    np.testing.assert_allclose(
        scene.truth.T_target_source @ lidar_site, map_site, rtol=0, atol=1e-8
    )


@pytest.mark.parametrize("kind", KINDS)
def test_without_bending_there_is_no_floor(clean, kind):
    truth = clean(kind).truth
    errors = pose_errors(truth.T_target_source, truth)
    assert errors.tre95_m < 1e-8
    assert errors.bending_floor95_m < 1e-8
    assert len(truth.surface_points) > 2000


@pytest.mark.parametrize("kind", KINDS)
def test_the_two_clouds_never_share_a_point(clean, kind):
    scene = clean(kind)
    T = scene.truth.T_target_source
    lidar = scene.lidar.frame.to_file(scene.lidar.xyz) @ T[:3, :3].T + T[:3, 3]
    drone = scene.photogrammetry.frame.to_file(scene.photogrammetry.xyz)
    distance, _ = cKDTree(drone - drone[0]).query(lidar - drone[0])
    assert (distance < 1e-4).mean() < 1e-3
    assert np.median(distance) < 0.6


def test_surface_points_are_seen_by_both(clean):
    scene = clean("hall")
    truth = scene.truth
    lidar = scene.lidar.frame.to_file(scene.lidar.xyz)
    near, _ = cKDTree(lidar).query(truth.surface_points)
    drone = scene.photogrammetry.frame.to_file(scene.photogrammetry.xyz)
    origin = drone[0]
    far, _ = cKDTree(drone - origin).query(truth.surface_bent - origin)
    assert np.median(near) < 0.6
    assert np.percentile(near, 90) < 4.0
    assert np.percentile(far, 90) < 1.5


def test_the_scanner_sees_under_the_eaves_and_the_drone_over_them(clean):
    scene = clean("hall")
    _, lidar = site_points(scene, scene.lidar, 0)
    _, drone = site_points(scene, scene.photogrammetry, 1)
    tracer = world_of("hall", 1)[1]
    shares = {}
    for name, points in (("lidar", lidar), ("drone", drone)):
        near = points[(np.abs(points[:, :2]) < (12.5, 10)).all(axis=1) & (points[:, 2] > 4.5)]
        above, _ = tracer.cast(near + (0, 0, 0.02), np.broadcast_to((0, 0, 1.0), near.shape))
        shares[name] = float((above < 2.5).mean())
    assert shares["lidar"] > 0.4
    assert shares["drone"] < 0.25
    assert shares["lidar"] > 2 * shares["drone"]


def test_density_falls_with_range(noisy):
    points = noisy.lidar.frame.to_file(noisy.lidar.xyz)
    is_first = noisy.lidar.attribute("station") == 0
    ground = is_first & (noisy.lidar.attribute("truth_label") == 2)
    radius = np.hypot(points[ground, 0], points[ground, 1])
    near = ((radius > 5) & (radius < 8)).sum() / (8**2 - 5**2)
    far = ((radius > 16) & (radius < 20)).sum() / (20**2 - 16**2)
    assert near > 4 * far > 0


def test_counts_labels_and_attributes(noisy):
    for cloud, target in ((noisy.lidar, 60_000), (noisy.photogrammetry, 40_000)):
        labels = cloud.attribute("truth_label")
        is_noise = np.isin(labels, (OUTLIER, NEAR_NOISE))
        assert (~is_noise).sum() == pytest.approx(target, rel=0.1)
        assert is_noise.mean() == pytest.approx(0.015, abs=0.001)
        assert labels.dtype == np.uint8
    labels = noisy.lidar.attribute("truth_label")
    assert 0.002 < (labels == MIXED).mean() < 0.08
    assert (labels == 1).mean() > 0.05
    assert noisy.lidar.attribute("intensity").dtype == np.uint16
    assert len(np.unique(noisy.lidar.attribute("station"))) == 7
    assert noisy.photogrammetry.attribute("red").dtype == np.uint16
    file = noisy.photogrammetry.frame.to_file(noisy.photogrammetry.xyz)
    assert np.median(file[:, 0]) == pytest.approx(5e5, abs=1e4)
    assert 2.7e6 < np.median(file[:, 1]) < 4.3e6
    assert "CGCS2000" in noisy.photogrammetry.frame.crs
    assert noisy.lidar.frame.crs is None


def test_some_outliers_lie_metres_below_ground(noisy):
    _, points = site_points(noisy, noisy.lidar, 0)
    is_outlier = noisy.lidar.attribute("truth_label") == OUTLIER
    assert (points[is_outlier, 2] < -2.0).mean() > 0.1
    assert points[is_outlier, 2].min() > -9.0


def test_mixed_pixels_lie_along_the_beam_beyond_or_before_the_surface(noisy):
    world, points = site_points(noisy, noisy.lidar, 0)
    mixed = noisy.lidar.attribute("truth_label") == MIXED
    station = world.stations[noisy.lidar.attribute("station")[mixed]]
    sight = points[mixed] - station
    distance = np.linalg.norm(sight, axis=1)
    tracer = world_of("hall", 5)[1].together_with(world.during_scan)
    found, _ = tracer.cast(station, sight / distance[:, None])
    off = np.abs(found - distance)
    assert np.median(off) > 0.03
    assert np.percentile(off, 95) < 2.6


def test_drone_noise_has_the_size_it_was_given(clean):
    noisy = scenes.make_scene(
        "wall", 1, lidar_points=5000, photogrammetry_points=20_000, bending=False, outliers=0.0,
        drone=Drone(noise_m=0.015),
    )  # fmt: skip
    world, points = site_points(noisy, noisy.photogrammetry, 1)
    is_ground = noisy.photogrammetry.attribute("truth_label") == 2
    high = points[is_ground] + (0, 0, 30.0)
    distance, face = world_of("wall", 1)[1].cast(high, np.broadcast_to((0, 0, -1.0), high.shape))
    off = (30.0 - distance)[world.static.labels[face] == 2]
    assert 0.006 < 1.4826 * np.median(np.abs(off)) < 0.02
    assert abs(np.median(off)) < 0.004


def test_the_same_seed_gives_the_same_bytes_on_any_thread_count():
    before = threads.get_threads()
    digests = set()
    for count in (1, 3):
        threads.set_threads(count)
        digests.add(
            digest(scenes.make_scene("hall", 2, lidar_points=6000, photogrammetry_points=5000))
        )
    threads.set_threads(before)
    assert len(digests) == 1
    other = scenes.make_scene("hall", 3, lidar_points=6000, photogrammetry_points=5000)
    assert digest(other) not in digests


def test_bending_is_centimetres_drawn_per_seed_and_the_best_pose_is_best(noisy):
    truth = noisy.truth
    errors = pose_errors(truth.T_best, truth)
    assert errors.tre95_m == 0
    assert 0.001 < errors.bending_floor95_m < 0.03

    def integral(matrix):
        left = displacements(matrix, truth.T_target_source, truth.surface_points)
        bend = truth.surface_bent - (
            truth.surface_points @ truth.T_target_source[:3, :3].T + truth.T_target_source[:3, 3]
        )
        return float(((left - bend) ** 2).sum())

    lowest = integral(truth.T_best)
    centre = truth.surface_points.mean(axis=0)
    rng = np.random.default_rng(0)
    for _ in range(30):
        nudge = np.eye(4)
        nudge[:3, :3] = survey.rotation(rng.normal(0, 2e-4, 3))
        nudge[:3, 3] = centre - nudge[:3, :3] @ centre + rng.normal(0, 5e-4, 3)
        assert integral(truth.T_best @ nudge) > lowest
    drawn = [draw_bending(np.zeros(3), 40.0, np.random.default_rng(k)) for k in range(30)]
    size = [np.linalg.norm(bend.at(np.array([[40.0, 0, 0]]))) for bend in drawn]
    assert 0.005 < np.median(size) < 0.05
    assert np.std(size) > 0.002


def test_poses_have_any_yaw_and_tilts_up_to_the_limit():
    world, _ = world_of("hall", 1)
    yaws, tilts = [], []
    for seed in range(60):
        scan, chart = survey.draw_poses(world, np.random.default_rng(seed), 0.6)
        up = scan[:3, 2]
        tilts.append(np.degrees(np.arctan2(np.hypot(*up[:2]), up[2])))
        total = chart[:3, :3] @ scan[:3, :3].T
        yaws.append(np.degrees(np.arctan2(total[1, 0], total[0, 0])))
    assert min(tilts) > 0.1
    assert max(tilts) <= 0.6
    assert np.histogram(yaws, 4, (-180, 180))[0].min() > 5


def test_people_cars_and_leaves_differ_between_the_surveys():
    world, _ = world_of("tulou", 1)
    distance, _ = cKDTree(world.during_flight.vertices).query(world.during_scan.vertices[::50])
    assert np.median(distance) > 0.01
    assert {3, 4} <= set(world.during_scan.labels.tolist()) & set(
        world.during_flight.labels.tolist()
    )


def test_range_offset_moves_points_along_the_beam(clean):
    kwargs = {
        "lidar_points": 3000,
        "photogrammetry_points": 3000,
        "bending": False,
        "outliers": 0.0,
        "drone": CLEAN_DRONE,
    }
    scene = scenes.make_scene(
        "wall", 1, scanner=CLEAN_SCANNER.model_copy(update={"range_offset_m": 0.05}), **kwargs
    )
    plain = scenes.make_scene("wall", 1, scanner=CLEAN_SCANNER, **kwargs)
    moved = np.linalg.norm(
        scene.lidar.frame.to_file(scene.lidar.xyz) - plain.lidar.frame.to_file(plain.lidar.xyz),
        axis=1,
    )
    np.testing.assert_allclose(moved, 0.05, atol=1e-9)


def test_what_the_compensator_leaves_tilts_each_station_by_itself():
    tracer = Tracer(world_of("wall", 1)[0].during_scan)
    stations = np.array([[0.0, -12.0, 2.0], [6.0, -15.0, 2.0]])
    quick = CLEAN_SCANNER.model_copy(update={"points": 3000, "outliers": 0.0})
    plain = scan(tracer, stations, quick, np.random.default_rng(0))
    spoilt = quick.model_copy(update={"compensator_error_deg": 0.05})
    tilted = scan(tracer, stations, spoilt, np.random.default_rng(0))
    turns = []
    for number, place in enumerate(stations):
        before, after = ((found.xyz - place)[found.sensor == number] for found in (plain, tilted))
        np.testing.assert_allclose(
            np.linalg.norm(before, axis=1), np.linalg.norm(after, axis=1), atol=1e-9
        )
        turn, _ = Rotation.align_vectors(after, before)
        np.testing.assert_allclose(turn.apply(before), after, atol=1e-7)
        turns.append(turn.as_rotvec(degrees=True))
    assert np.abs(turns)[:, 2].max() < 1e-6
    assert 1e-3 < np.abs(np.subtract(*turns)).max() < 0.3


def test_unknown_kind_is_refused():
    with pytest.raises(InputError, match="hall, pagoda, tulou, wall, cave"):
        scenes.make_scene("church")


def test_scan_mesh_finds_its_own_stations():
    house = join([box((-4, -3, -0.2), (4, 3, 3.2), "plaster"), box((-5, -4, 3.2), (5, 4, 3.5))])
    shifted = house.vertices + (1000.0, -500.0, 20.0)
    scene = scenes.scan_mesh(
        shifted, house.faces, seed=3, lidar_points=20_000, photogrammetry_points=15_000,
        face_labels=np.ones(len(house)), stations=5, bending=False,
    )  # fmt: skip
    errors = pose_errors(scene.truth.T_target_source, scene.truth)
    assert errors.tre95_m < 1e-8
    assert len(np.unique(scene.lidar.attribute("station"))) == 5
    for cloud in (scene.lidar, scene.photogrammetry):
        assert {1, 2} <= set(cloud.attribute("truth_label").tolist())


def test_scan_mesh_refuses_wrong_labels():
    house: Mesh = box((-4, -3, 0), (4, 3, 3))
    with pytest.raises(InputError, match="face_labels"):
        scenes.scan_mesh(house.vertices, house.faces, face_labels=[1, 2])


@pytest.mark.data
@pytest.mark.parametrize(
    ("path", "is_y_up"),
    [("nuyda_house/nuyda.ply", False), ("monastery_mesh/samurai_monastry.obj.gz", True)],
)
def test_real_meshes(data, path, is_y_up):
    from dougong.evaluation.mesh import load_mesh

    vertices, faces = load_mesh(data / path, is_y_up=is_y_up)
    scene = scenes.scan_mesh(
        vertices, faces, lidar_points=30_000, photogrammetry_points=20_000, bending=False
    )
    assert len(scene.truth.surface_points) > 1500
    assert pose_errors(scene.truth.T_target_source, scene.truth).tre95_m < 1e-8
    assert len(np.unique(scene.lidar.attribute("station"))) == 8
