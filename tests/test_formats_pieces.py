"""A cloud that comes in pieces is written as the whole is."""

import tracemalloc

import numpy as np
import pytest

from dougong.cloud import Cloud, joined_pieces
from dougong.errors import InputError, OutputError
from dougong.formats import read, write, write_merged
from dougong.formats.las_pieces import las_form
from test_formats_las import random_las

TURN = np.array([[0.6, -0.8, 0, 5e5], [0.8, 0.6, 0, 4e6], [0, 0, 1, 30.0], [0, 0, 0, 1]])


def pieces_of(cloud, size):
    """Return `cloud` in pieces, an empty one among them."""

    def pieces():
        for start in range(0, len(cloud), size):
            yield cloud.select(np.arange(start, min(start + size, len(cloud))))
            yield cloud.select(np.arange(0))

    return pieces


@pytest.fixture(params=["las", "moved las", "floats", "moved floats"])
def cloud(request, tmp_path):
    if "las" in request.param:
        random_las(tmp_path / "a.las", 3, "1.2", count=2000)
        found = read(tmp_path / "a.las")
    else:
        rng = np.random.default_rng(2)
        # No single piece shows that intensities are fractions and a class does not fit a byte.
        intensity = np.arange(2000.0)
        intensity[1990] += 0.5
        kind = np.zeros(2000, "u2")
        kind[3] = 300
        points = rng.uniform(-5, 5, (2000, 3))
        found = Cloud.from_points(points, intensity=intensity, classification=kind)
    return found.moved(TURN) if "moved" in request.param else found


@pytest.mark.parametrize("suffix", [".las", ".laz", ".copc.laz", ".ply"])
def test_pieces_are_written_as_the_whole(cloud, tmp_path, suffix):
    whole = write(cloud, tmp_path / f"whole{suffix}")
    parts = write(pieces_of(cloud, 700), tmp_path / f"parts{suffix}")
    assert (tmp_path / parts.path).read_bytes() == (tmp_path / whole.path).read_bytes()
    assert parts.notes == whole.notes
    assert parts.points == whole.points == len(cloud)


@pytest.mark.parametrize(("last", "kept"), [(512, "u1"), (257, "u2"), (255, "u2")])
def test_colours_are_those_of_the_whole_whatever_a_piece_shows(tmp_path, last, kept):
    random_las(tmp_path / "a.las", 2, "1.2", count=2000)
    cloud = read(tmp_path / "a.las")
    for name in ("red", "green", "blue"):
        colour = np.zeros(2000, "u2")
        colour[700:], colour[1999] = 256, last
        cloud = cloud.with_attribute(name, colour)
    whole = write(cloud, tmp_path / "whole.ply")
    parts = write(pieces_of(cloud, 700), tmp_path / "parts.ply")
    assert (tmp_path / "parts.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()
    assert parts.notes == whole.notes
    assert read(tmp_path / "parts.ply").attribute("red").dtype == kept


def test_ply_of_any_size_holds_a_piece_at_a_time(tmp_path):
    piece = Cloud.from_points(np.random.default_rng(0).uniform(0, 9, (50_000, 3)))

    def pieces():
        yield from (piece for _ in range(40))

    tracemalloc.start()
    assert write(pieces, tmp_path / "a.ply").points == 2_000_000
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 10_000_000


def test_pieces_are_merged_as_the_whole(cloud, tmp_path):
    other = Cloud.from_points(cloud.frame.to_file(cloud.xyz[:10]), scalar=np.arange(10.0))
    one = write_merged([cloud, other], tmp_path / "a.copc.laz", source_ids=[1, 2])
    two = write_merged([pieces_of(cloud, 700), other], tmp_path / "b.copc.laz", source_ids=[1, 2])
    assert (tmp_path / "a.copc.laz").read_bytes() == (tmp_path / "b.copc.laz").read_bytes()
    assert one.notes == two.notes
    assert one.points == two.points


def test_pieces_are_finished_as_they_are_written_and_only_then(cloud, tmp_path):
    finished = []

    def finish(piece):
        finished.append(len(piece))
        return piece.with_attribute("far", np.asarray(piece.xyz[:, 0] * 2, dtype="f4"))

    before = write_merged([finish(cloud)], tmp_path / "a.copc.laz", source_ids=[1])
    finished.clear()
    asked = {"source_ids": [1], "finish": [finish]}
    after = write_merged([pieces_of(cloud, 700)], tmp_path / "b.copc.laz", **asked)
    assert (tmp_path / "a.copc.laz").read_bytes() == (tmp_path / "b.copc.laz").read_bytes()
    assert before.notes == after.notes
    assert sum(finished) == len(cloud) + 1  # the form is told by one point


def test_the_form_knows_where_the_points_lie(cloud, tmp_path):
    form = las_form(pieces_of(cloud, 700))
    written = read(write(cloud, tmp_path / "b.las").path)
    there = written.frame.to_file(written.xyz)
    assert form.corners == pytest.approx(np.stack([there.min(axis=0), there.max(axis=0)]))


def test_pieces_without_points_and_no_pieces_are_refused(cloud, tmp_path):
    with pytest.raises(OutputError, match="has no points left"):
        write(lambda: (cloud.select(np.arange(0)),), tmp_path / "a.laz")
    with pytest.raises(InputError, match="at least one piece"):
        las_form(lambda: ())
    assert not (tmp_path / "a.laz").exists()


def test_pieces_join_to_the_whole(cloud):
    again = joined_pieces(pieces_of(cloud, 300))
    assert again.records.tobytes() == cloud.records.tobytes()
    assert np.array_equal(again.xyz, cloud.xyz)
