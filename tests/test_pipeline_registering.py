"""What reference systems say about a pair, around the search itself."""

import numpy as np
import pytest

import dougong
from dougong.cloud import Cloud
from dougong.errors import FrameError
from dougong.formats.units import as_wkt
from dougong.pipeline import registering
from dougong.registration.result import Registration

POINTS = np.array([[500_000.0, 4_000_000, 10], [500_010, 4_000_010, 20]])


@pytest.fixture(autouse=True)
def without_search(monkeypatch):
    found = Registration(
        status="ok", matrix=np.eye(4), reason="", probability=1.0, scale=1.0, dof=6,
        coarse_method="plan", hypotheses=(), margin=1.0, fine=None, notes=("searched",),
    )  # fmt: skip
    monkeypatch.setattr(registering, "search", lambda *_, **__: found)


def notes(source, target):
    one = Cloud.from_points(POINTS, name="scan", crs=source)
    two = Cloud.from_points(POINTS, name="drone", crs=target)
    return dougong.register(one, two).notes


def test_two_systems_are_named_before_what_the_search_says():
    said = notes("EPSG:32650", "EPSG:4547")
    assert "scan is in WGS 84 / UTM zone 50N" in said[0]
    assert "drone in CGCS2000 / 3-degree Gauss-Kruger CM 114E" in said[0]
    assert said[-1] == "searched"


@pytest.mark.parametrize(
    ("source", "target"),
    [
        (None, None),
        ("EPSG:32650", "EPSG:32650"),
        ("EPSG:32650", as_wkt("EPSG:32650")),
    ],
)
def test_the_same_system_in_other_words_and_scanner_frames_are_no_news(source, target):
    assert notes(source, target) == ("searched",)


def test_degrees_are_refused_for_either_cloud():
    degrees = Cloud.from_points([[116.0, 39, 0], [116.001, 39.001, 9]], crs="EPSG:4326")
    metres = Cloud.from_points(POINTS)
    for pair in ((degrees, metres), (metres, degrees)):
        with pytest.raises(FrameError, match=r"degrees.*Reproject it to UTM"):
            dougong.register(*pair)


def test_duplicates_do_not_outweigh_the_site(monkeypatch):
    seen = []
    real = registering.search
    monkeypatch.setattr(
        registering, "search", lambda *clouds, **kw: seen.append(clouds) or real(*clouds, **kw)
    )
    heap = Cloud.from_points(np.vstack([POINTS, np.repeat(POINTS[:1], 1000, axis=0)]))
    dougong.register(heap, Cloud.from_points(POINTS))
    assert [len(cloud) for cloud in seen[0][:2]] == [2, 2]
    np.testing.assert_array_equal(seen[0][0].frame.to_file(seen[0][0].xyz), POINTS)


def test_a_file_without_a_system_among_the_coordinates_of_another_is_taken_to_share_it():
    said = notes(None, "EPSG:32650")
    assert said[0].startswith("scan has no coordinate system, and its coordinates lie within")
    assert len(said) == 2
