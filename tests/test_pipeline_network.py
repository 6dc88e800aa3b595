"""Many clouds in one frame: who is placed by whom, what checks it, and what is named wrong."""

from types import SimpleNamespace

import numpy as np
import pytest

import dougong
from dougong.cloud import Cloud, Frame
from dougong.pipeline.progress import Silent
from dougong.pipeline.project import Project
from dougong.pipeline.run import run
from dougong.pipeline.store import Store
from dougong.registration.network import PairLink, join, local_matrix
from dougong.registration.result import FineResult, Hypothesis, Registration
from registration_sites import motion

NAMES = ("a", "b", "c", "d", "e")
TRUTH = {name: motion(37.0 * k, (5.0 * k, -3.0 * k, 0.2 * k)) for k, name in enumerate(NAMES)}
"""From site coordinates to each cloud's file coordinates."""


def exact(source, target):
    return TRUTH[target] @ np.linalg.inv(TRUTH[source])


def sure(source, target, matrix):
    """Return a registration that is sure of `matrix`, to millimetres."""
    T = local_matrix(matrix, source.frame, target.frame)
    return Registration(
        status="ok",
        matrix=matrix,
        reason="as the test says.",
        probability=0.9,
        scale=1.0,
        dof=6,
        coarse_method="plan",
        hypotheses=(Hypothesis(T_target_source=matrix, score=0.7, method="plan"),),
        margin=0.5,
        fine=FineResult(
            T_target_source=T,
            method="point-to-plane",
            iterations=9,
            stopped="converged",
            fitness=0.5,
            inlier_rmse_m=0.004,
            max_distance_m=0.05,
            overlap_source=0.5,
            overlap_target=0.5,
            covariance=np.diag([1e-9] * 3 + [1e-6] * 3),
            covariance_about=np.zeros(3),
            covariance_blocks=50,
        ),
    )


def failed():
    return Registration(
        status="failed",
        matrix=None,
        reason="nothing in common.",
        probability=0.0,
        scale=1.0,
        dof=6,
        coarse_method="plan",
        hypotheses=(),
        margin=0.0,
        fine=None,
    )


@pytest.fixture
def network(tmp_path, monkeypatch):
    """Return a function that runs the five clouds with the links that hold."""
    rng = np.random.default_rng(0)

    def scanned(name, apart_m):
        site = np.column_stack([rng.uniform(0, 20, (6000, 2)), rng.normal(0, 0.003, 6000)])
        site[:, 0] += apart_m * NAMES.index(name)
        T = TRUTH[name]
        dougong.write(Cloud.from_points(site @ T[:3, :3].T + T[:3, 3]), tmp_path / f"{name}.laz")

    entries = [{"name": n, "kind": "lidar", "files": [f"{n}.laz"]} for n in NAMES]

    def going(holds, wrong=(), apart_m=0.0):
        for name in NAMES:
            scanned(name, apart_m)

        def register(source, target, params, **_):
            pair = (source.name, target.name)
            if pair in wrong:
                off = motion(3.0, (0.4, 0.0, 0.0))
                return sure(source, target, off @ exact(*pair))
            return sure(source, target, exact(*pair)) if holds(*pair) else failed()

        monkeypatch.setattr("dougong.pipeline.links.register", register)
        out = tmp_path / f"out{len(list(tmp_path.glob('out*')))}"
        out.mkdir()
        project = Project.model_validate({"cloud": entries})
        store = Store.beside(tmp_path / "project")
        return run(project, tmp_path, out, store=store, progress=Silent())

    return going


def neighbours(one, other):
    return abs(NAMES.index(one) - NAMES.index(other)) == 1


def misses(result):
    """Return how far each placed cloud lies from its true place, metres."""
    found = {}
    for document in result["registrations"]:
        if document["status"] == "ok":
            off = np.array(document["matrix"]) - exact(document["source"], "a")
            found[document["source"]] = float(np.abs(off).max())
    return found


def test_a_cloud_is_reached_through_others(network):
    result = network(neighbours, apart_m=10.0)
    assert set(misses(result)) == set("bcde")
    assert max(misses(result).values()) < 1e-3
    last = result["registrations"][-1]
    assert last["source"] == "e"
    assert last["target"] == "a"
    assert "Reached through d" in last["reason"]
    assert set(result["merged"]["clouds"]) == set(NAMES)


def test_what_no_link_reaches_is_named_and_left_out(network):
    result = network(lambda one, other: "e" not in (one, other))
    assert result["network"]["unreached"] == ["e"]
    assert result["status"] == "failed"
    assert set(result["merged"]["clouds"]) == set("abcd")


def test_a_cloud_that_cannot_be_registered_does_not_stop_the_others(network):
    def holds(one, other):
        if "e" in (one, other):
            raise dougong.RegistrationError("e has too few usable points (3).")
        return True

    result = network(holds)
    assert result["network"]["unreached"] == ["e"]
    assert result["registrations"][-1]["reason"] == "e has too few usable points (3)."
    assert set(result["merged"]["clouds"]) == set("abcd")


def test_a_reference_that_cannot_be_registered_onto_is_an_error(network):
    def holds(one, other):
        raise dougong.RegistrationError(f"{other} is not levelled.")

    with pytest.raises(dougong.RegistrationError, match="a is not levelled"):
        network(holds)


def test_a_wrong_link_is_named_and_left_out(network):
    result = network(lambda *_: True, wrong=[("c", "b")])
    left_out = [(r["source"], r["target"]) for r in result["network"]["links"] if r["is_left_out"]]
    assert left_out == [("c", "b")]
    assert max(misses(result).values()) < 1e-3
    assert set(misses(result)) == set("bcde")


def test_a_wrong_link_that_nothing_outvotes_makes_its_clouds_unsure(network):
    """A chain closed by one more link: one of the loop is wrong, and nobody can say which."""
    ring = {("a", "e"), ("e", "a")}
    result = network(lambda *pair: neighbours(*pair) or pair in ring, wrong=[("c", "b")])
    for name, miss in misses(result).items():
        assert miss < 1e-3, name
    assert result["status"] == "ambiguous"


def test_a_lone_link_that_others_should_confirm_is_unsure(network):
    """d and e agree with each other, hang on one wrong link, and overlap all the others by it."""

    def holds(one, other):
        return ({one, other} <= set("abc")) or {one, other} == set("de")

    result = network(holds, wrong=[("d", "c")])
    assert set(misses(result)) == set("bc")
    assert set(result["network"]["contradicted"]) == set("de")


@pytest.mark.parametrize("order", [(0, 1, 2, 3), (3, 0, 1, 2), (2, 3, 1, 0)])
def test_a_lone_link_is_doubted_for_what_hangs_on_it_in_any_order_of_links(order):
    """a triangle that contradicts itself is no word against e, which hangs on a beside it."""
    frames = {name: Frame() for name in "abce"}

    def link(source, target, x, y=0.0):
        matrix = motion(0.0, (x, y, 0.0))
        clouds = (SimpleNamespace(frame=Frame()), SimpleNamespace(frame=Frame()))
        return PairLink(source=source, target=target, result=sure(*clouds, matrix))

    links = [link("b", "a", 1), link("c", "b", 1), link("c", "a", 3), link("e", "a", 0, 5)]
    joined = join(frames, "a", [links[k] for k in order])
    assert joined.contradicted == ()
    assert "e" in joined.matrices


def test_two_clouds_have_no_network(network, tmp_path):
    entries = [{"name": n, "kind": "lidar", "files": [f"{n}.laz"]} for n in "ab"]
    network(neighbours)
    (tmp_path / "two").mkdir()
    store = Store.beside(tmp_path / "project")
    project = Project.model_validate({"cloud": entries})
    result = run(project, tmp_path, tmp_path / "two", store=store, progress=Silent())
    assert result["network"] is None
