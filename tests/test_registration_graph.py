"""Networks of links: adjusted to the truth, the wrong link named."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dougong.registration.graph import Link, adjust_network
from dougong.registration.overlap import apply, inverse
from registration_sites import motion

SIGMA_M, SIGMA_RAD = 0.003, 1e-4


def ring(count, seed=0, levelled=False):
    """Return true poses of stations round a building, and noisy links to the next two."""
    rng = np.random.default_rng(seed)
    truth = {}
    for k in range(count):
        angle = 2 * np.pi * k / count
        place = (30 * np.cos(angle), 30 * np.sin(angle), 0.3 * k)
        tilt = 0.0 if levelled else rng.normal(0, 0.5)
        truth[f"s{k:02d}"] = motion(rng.uniform(0, 360), place, tilt)
    zero = inverse(truth["s00"])
    truth = {name: zero @ T for name, T in truth.items()}
    names = list(truth)
    links = [
        link(rng, truth, names[k], names[(k + step) % count], levelled)
        for k in range(count)
        for step in (1, 2)
    ]
    return truth, links


def link(rng, truth, source, target, levelled=False):
    exact = inverse(truth[target]) @ truth[source]
    about = apply(exact, np.zeros((1, 3)))[0] / 2
    turn = rng.normal(0, SIGMA_RAD, 3) * ([0, 0, 1] if levelled else 1)
    noisy = np.eye(4)
    noisy[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    noisy[:3, 3] = about - noisy[:3, :3] @ about + rng.normal(0, SIGMA_M, 3)
    covariance = np.diag([SIGMA_RAD**2] * 3 + [SIGMA_M**2] * 3)
    return Link(
        source=source,
        target=target,
        T_target_source=noisy @ exact,
        covariance=covariance,
        about=about,
    )


def errors(network, truth):
    return {
        name: np.linalg.norm(network.poses[name][:3, 3] - T[:3, 3]) for name, T in truth.items()
    }


@pytest.mark.parametrize("dof", [6, 4])
def test_redundant_links_are_adjusted(dof):
    # Stations of a level ring stand level to each other only where the first one does.
    truth, links = ring(12, 1, levelled=dof == 4)
    network = adjust_network(list(truth), "s00", links, dof=dof)
    assert network.bad == ()
    assert network.unreached == ()
    assert max(errors(network, truth).values()) < 0.02
    assert all(report.is_checked for report in network.links)
    assert max(report.loop_error_m for report in network.links) < 0.03


def test_the_adjustment_is_better_than_a_chain():
    chain, whole = [], []
    for seed in range(6):
        truth, links = ring(12, seed)
        whole.append(errors(adjust_network(list(truth), "s00", links), truth)["s06"])
        half = [
            item for item in links if item.name in {f"s{k:02d} -> s{k + 1:02d}" for k in range(6)}
        ]
        chain.append(
            errors(adjust_network(list(truth)[:7], "s00", half), {"s06": truth["s06"]})["s06"]
        )
    assert np.mean(whole) < 0.8 * np.mean(chain)


@pytest.mark.parametrize("bad", [0, 7, 23])
def test_a_wrong_link_is_named_and_counts_for_nothing(bad):
    truth, links = ring(12, 2)
    wrong = links[bad]
    links[bad] = Link(
        source=wrong.source,
        target=wrong.target,
        T_target_source=motion(90, (0.5, -0.3, 0.0)) @ wrong.T_target_source,
        covariance=wrong.covariance,
        about=wrong.about,
    )
    network = adjust_network(list(truth), "s00", links)
    assert network.bad == (wrong.name,)
    assert max(errors(network, truth).values()) < 0.02
    assert network.links[bad].loop_error_m > 0.3


def test_a_link_without_a_loop_is_not_checked_and_islands_are_told():
    truth, links = ring(5, 3)
    names = [*truth, "far", "farther"]
    rng = np.random.default_rng(0)
    truth |= {"far": motion(20, (90, 0, 0)), "farther": motion(20, (95, 0, 0))}
    truth |= {"arm": motion(70, (40, 5, 1))}
    links += [link(rng, truth, "farther", "far"), link(rng, truth, "arm", "s03")]
    network = adjust_network([*names, "arm"], "s00", links)
    assert network.unreached == ("far", "farther")
    report = network.links[-1]
    assert report.name == "arm -> s03"
    assert not report.is_checked
    assert errors(network, {"arm": truth["arm"]})["arm"] < 0.03


def test_covariance_covers_the_error():
    values = []
    for seed in range(25):
        truth, links = ring(8, seed + 50)
        network = adjust_network(list(truth), "s00", links)
        T = network.poses["s04"] @ inverse(truth["s04"])
        centre = network.poses["s04"][:3, 3]
        turn = Rotation.from_matrix(T[:3, :3]).as_rotvec()
        error = np.concatenate([turn, centre - truth["s04"][:3, 3]])
        values.append(error @ np.linalg.solve(network.covariances["s04"], error) / 6)
    # The robust weights and the floor move it a little from 1.
    assert 0.5 < np.mean(values) < 1.6
