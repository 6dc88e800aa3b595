"""Clutter through the commands: marked where asked, removed only when asked, on tiles the same."""

import json
from dataclasses import replace

import numpy as np
import pytest

import dougong
from dougong import app
from dougong.cli import call
from dougong.cloud import BitField, Cloud
from dougong.pipeline import memory
from dougong.pipeline.marking import marked, with_classes
from dougong.pipeline.progress import Silent
from test_filters_clutter import on_ground
from test_pipeline_large import SMALL, bytes_of, comparable

ASKED = {"memory_bytes": None, "progress": Silent(), "overwrite": True}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("clutter")
    dougong.write(Cloud.from_points(on_ground()), folder / "in.laz")
    return folder


def filtered(folder, name, *settings, **asked):
    """Return the output and the books of ``dougong filter``."""
    asked = {"kind": None, "only": None, "mark": False, **ASKED, **asked}
    app.filter_file(folder / "in.laz", folder / name, settings=settings, **asked)
    return dougong.read(folder / name), json.loads((folder / f"{name}.json").read_text())


def test_alone_it_marks_and_removes_only_when_asked(folder):
    out, books = filtered(folder, "marked.laz", only="clutter")
    kind = out.attribute("dougong_clutter")
    assert len(out) == books["points_in"] == books["points_kept"]
    np.testing.assert_array_equal(out.attribute("classification") == 64, kind > 0)
    assert books["stages"][-1]["found"]["person_clusters"] == 4
    assert ((out.attribute("dougong_clutter_margin") > 0) <= (kind > 0)).all()
    clean, books = filtered(folder, "clean.laz", "clutter.action=remove", only="clutter")
    assert len(clean) == int((kind == 0).sum())
    assert clean.attribute("dougong_clutter") is None
    assert books["reasons"]["clutter"] == {"code": 8, "points": int((kind > 0).sum())}


def test_removed_clutter_is_not_noise(folder):
    out, _ = filtered(folder, "all.laz", "clutter.action=remove", only="clutter", mark=True)
    is_gone = out.attribute("dougong_reason") == 8
    assert is_gone.any()
    np.testing.assert_array_equal(out.attribute("classification") == 64, is_gone)


def test_a_recipe_looks_for_it_only_when_asked(folder):
    plain, books = filtered(folder, "plain.laz", kind="lidar")
    assert "clutter" not in [stage["name"] for stage in books["stages"]]
    assert plain.attribute("dougong_clutter") is None
    marked, _ = filtered(folder, "offered.laz", "clutter.action=mark", kind="lidar")
    assert len(marked) == len(plain)
    assert set(np.unique(marked.attribute("dougong_clutter"))) == {0, 1, 2, 3, 4}


def test_old_point_formats_keep_their_class():
    cloud = Cloud.from_points(np.zeros((3, 3)), packed=np.array([1, 2, 3], np.uint8))
    old = replace(cloud, bits={"classification": BitField("packed", 0b11111)})
    chosen = np.array([True, False, False])
    assert with_classes(old, [(chosen, 64)]).attribute("classification").tolist() == [1, 2, 3]
    assert with_classes(old, [(chosen, 7)]).attribute("classification").tolist() == [7, 2, 3]


@pytest.mark.parametrize(
    ("kind", "label", "stays"),
    [("u2", 300, True), ("i4", -5, True), ("f8", 1.5, True), ("u1", 9, True), ("?", 1, False)],
)
def test_classes_and_their_backup_keep_their_numbers(kind, label, stays):
    labels = np.array([label, label, 1], kind)
    cloud = Cloud.from_points(np.zeros((3, 3)), classification=labels)
    found = with_classes(cloud, [(np.array([True, False, False]), 64)])
    assert found.attribute("classification").tolist() == [64, label, 1]
    assert found.attribute("classification_in").tolist() == labels.tolist()
    assert found.attribute("classification_in").dtype == labels.dtype
    assert (found.attribute("classification").dtype == labels.dtype) == stays


def test_marks_of_an_earlier_run_are_replaced_whatever_type_they_came_back_in():
    zeros = np.zeros(2, np.uint8)  # as a text file's column of zeros is read
    cloud = Cloud.from_points(np.zeros((2, 3)), dougong_margin=zeros)
    margin = np.array([0.25, 3.5], np.float32)
    again = marked(cloud, zeros, zeros, {"dougong_margin": margin})
    np.testing.assert_array_equal(again.attribute("dougong_margin"), margin)


def test_a_run_tells_of_it_on_tiles_too(folder, monkeypatch):
    for name, value in SMALL.items():
        monkeypatch.setattr(memory, name, value)
    monkeypatch.setattr("dougong.pipeline.tiled.CHUNK_POINTS", 5000)
    monkeypatch.setattr("dougong.app._build_report", lambda *_: None)
    cloud = '[[cloud]]\nname = "scan"\nkind = "lidar"\nfiles = ["in.laz"]\n'
    marking = '[filter.lidar.clutter]\naction = "mark"\n'
    (folder / "site.toml").write_text(cloud + marking)
    assert not memory.Room(1e6, is_asked=True).holds(len(on_ground()), 0)
    results = {}
    for name, room in (("whole", "4GB"), ("tiles", "1MB")):
        tokens = ["run", str(folder / "site.toml"), "--out", str(folder / name)]
        assert call([*tokens, "--memory", room, "--quiet"]) == 0
        results[name] = comparable(json.loads((folder / name / "result.json").read_text()))
    assert results["whole"] == results["tiles"]
    stages = {stage["name"]: stage for stage in results["whole"]["clouds"][0]["stages"]}
    assert stages["clutter"]["found"]["person_clusters"] >= 2
    assert bytes_of(folder / "whole") == bytes_of(folder / "tiles")
    merged = dougong.read(folder / "whole" / "merged.copc.laz")
    assert set(np.unique(merged.attribute("dougong_clutter"))) == {0, 1, 2, 3, 4}
