"""Tiles on a Dask cluster that shares no disk: S3 between its workers, some of which die."""

import os
import signal
import threading
import time

import numpy as np
import pytest

from dougong.cli import call
from dougong.tiles.engine import set_engine
from tile_scans import filtered_by, make_little_room, write_scan

distributed = pytest.importorskip("distributed")
pytestmark = pytest.mark.filterwarnings("ignore")  # of the cluster's own


@pytest.fixture
def scan(tmp_path, monkeypatch):
    make_little_room(monkeypatch)
    yield write_scan(tmp_path / "scan.laz")
    set_engine("local")


@pytest.fixture
def cluster():
    made = []

    def start(workers, **options):
        made.append(
            distributed.LocalCluster(
                n_workers=workers, threads_per_worker=1, dashboard_address=None, **options
            )
        )
        return made[0], made[0].scheduler_address.replace("tcp://", "dask://")

    yield start
    for one in made:
        one.close()


def test_a_cluster_on_shared_storage_gives_the_same_though_a_worker_is_killed(
    scan, tmp_path, cluster, bucket
):
    url, keys = bucket
    whole, _ = filtered_by(scan, tmp_path / "whole.laz", "--kind", "lidar", "--memory", "4GB")
    scratch = tmp_path / "workers"
    workers, address = cluster(2, local_directory=str(scratch))
    killed = []

    def kill_one():
        while not any("tiles.json" in key for key in keys()):
            time.sleep(0.05)
        time.sleep(0.3)  # into the first stages
        killed.append(next(iter(workers.workers.values())).pid)
        os.kill(killed[0], signal.SIGKILL)

    killer = threading.Thread(target=kill_one)
    killer.start()
    options = ("--kind", "lidar", "--memory", "190kB", "--work", url, "--engine", address)
    tiled, _ = filtered_by(scan, tmp_path / "tiled.laz", *options)
    killer.join()
    np.testing.assert_array_equal(tiled.records, whole.records)
    assert killed[0] not in {worker.pid for worker in workers.workers.values()}
    # Neither the workers' copies nor the tiles while they were cut are left.
    assert not list(scratch.rglob("*.npz"))
    left = {path.name.partition(".")[0] for path in tmp_path.iterdir()}
    assert left == {"scan", "whole", "tiled", "workers"}


def told_by(scan, tmp_path, address, capsys):
    tokens = ["filter", str(scan), str(tmp_path / "out.laz"), "--kind", "lidar", "--quiet"]
    code = call([*tokens, "--memory", "190kB", "--engine", address])
    return code, capsys.readouterr().err


def test_no_scheduler_is_one_sentence(scan, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("dougong.tiles.cluster._ANSWER_SECONDS", 1)
    code, said = told_by(scan, tmp_path, "dask://127.0.0.1:9", capsys)
    assert code == 1
    assert said.startswith("error: --engine dask://127.0.0.1:9: no scheduler answers there")


def test_a_scheduler_without_workers_is_one_sentence(scan, tmp_path, monkeypatch, capsys, cluster):
    monkeypatch.setattr("dougong.tiles.cluster._JOIN_SECONDS", 0.2)
    _, address = cluster(0)
    code, said = told_by(scan, tmp_path, address, capsys)
    assert code == 1
    assert "the scheduler has no workers. Start some with `dask worker 127.0.0.1:" in said


def test_a_worker_of_another_version_is_one_sentence(scan, tmp_path, monkeypatch, capsys, cluster):
    _, address = cluster(1)
    monkeypatch.setattr("dougong.__version__", "9.9.9")
    code, said = told_by(scan, tmp_path, address, capsys)
    assert code == 2
    assert "has dougong 0." in said
    assert "this is 9.9.9. Install the same version there." in said
