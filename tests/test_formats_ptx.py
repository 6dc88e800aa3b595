"""PTX: poses applied, stations apart, cells without an echo dropped, one sentence for the rest."""

import numpy as np
import pytest

from dougong.errors import FormatError
from dougong.formats import check, describe, iterate, read, read_stations, write
from dougong.pipeline.guess import guess_kind


def pose(yaw, place):
    """Return the 4 x 4 matrix for row vectors of a scanner turned by `yaw` at `place`."""
    matrix = np.eye(4)
    matrix[:2, :2] = [[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]]
    matrix[3, :3] = place
    return matrix


def ptx(scans, size):
    """Return the text of a PTX file of scans (matrix, rows of text)."""
    lines = []
    for matrix, rows in scans:
        lines += [str(size[0]), str(size[1]), " ".join(map(str, matrix[3, :3]))]
        lines += [" ".join(f"{v:.6f}" for v in axis) for axis in matrix[:3, :3]]
        lines += [" ".join(f"{v:.6f}" for v in row) for row in matrix]
        lines += rows
    return "\n".join(lines) + "\n"


@pytest.fixture
def survey(tmp_path):
    """Two coloured scans of 20 x 30 cells, 17 of them without an echo; what they hold."""
    rng = np.random.default_rng(0)
    poses = pose(0.3, [500_000.25, 4_000_000.5, 12.0]), pose(-2.0, [500_020.0, 4_000_003.0, 12.5])
    scans, truth = [], []
    for matrix in poses:
        local = np.round(rng.uniform(-20, 20, (600, 3)), 4)
        colour = rng.integers(0, 256, (600, 3))
        rows = [
            f"{x} {y} {z} {i:.3f} {r} {g} {b}"
            for (x, y, z), (r, g, b), i in zip(local, colour, rng.random(600), strict=True)
        ]
        for k in range(40, 57):
            rows[k] = "0 0 0 0.5 0 0 0"
        scans.append((matrix, rows))
        is_hit = np.ones(600, bool)
        is_hit[40:57] = False
        truth.append((local @ matrix[:3, :3] + matrix[3, :3])[is_hit])
    path = tmp_path / "two.ptx"
    path.write_text(ptx(scans, (20, 30)))
    return path, truth


def test_every_scan_is_a_station_with_its_pose_applied(survey):
    path, truth = survey
    clouds = read_stations(path)
    assert [cloud.name for cloud in clouds] == ["two_1", "two_2"]
    for cloud, expected in zip(clouds, truth, strict=True):
        # Six decimals of the matrix at 35 m.
        assert np.abs(cloud.frame.to_file(cloud.xyz) - expected).max() < 5e-5
        assert "17 of 600 points were marked invalid by the file and were dropped." in cloud.notes
        assert cloud.attribute("red").dtype == np.uint8
    info = describe(path)
    assert (info.format, info.stations, info.points) == ("PTX", 2, 1200)
    assert guess_kind(info)[0] == "lidar"


def test_whole_chunks_and_a_copy_in_laz_agree(survey, tmp_path):
    path, truth = survey
    whole = read(path)
    assert whole.attribute("station").tolist() == [0] * 583 + [1] * 583
    parts = list(iterate(path, 100))
    assert np.array_equal(np.concatenate([part.xyz for part in parts]), whole.xyz)
    write(whole, tmp_path / "two.laz")
    again = read(tmp_path / "two.laz")
    assert np.abs(again.frame.to_file(again.xyz) - np.concatenate(truth)).max() < 2e-4
    assert np.array_equal(again.attribute("blue") // 257, whole.attribute("blue"))
    write(whole, tmp_path / "two.e57")
    again = read(tmp_path / "two.e57")
    assert np.abs(again.frame.to_file(again.xyz) - np.concatenate(truth)).max() < 2e-4
    assert not any(finding.severity == "error" for finding in check(path))


def test_four_columns_and_blank_lines_between_scans(tmp_path):
    rows = ["1 0 0 0.25", "0 2 0 1", "0 0 0 0.5", "0 0 3 0"]
    text = ptx([(pose(0, [10, 20, 30]), rows)], (2, 2))
    (tmp_path / "a.ptx").write_text(text + "\n\n" + text)
    cloud = read(tmp_path / "a.ptx")
    assert cloud.frame.to_file(cloud.xyz).tolist() == [[11, 20, 30], [10, 22, 30], [10, 20, 33]] * 2
    assert cloud.attribute("intensity").tolist() == [0.25, 1, 0] * 2


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda text: text[: len(text) // 2], "should hold 4 points, file ends after"),
        (lambda text: text.replace("0.000000 1.000000", "0.000000 two"), "line 5 of the header"),
        (lambda text: text.replace("1.000000", "2.000000"), "is no rotation"),
        (lambda text: text.replace("1 0 0 0.25", "1 0 0 0.25 7"), "has 5 columns"),
        (lambda text: "-2\n" + text.partition("\n")[2], "line 1 of the header"),
        (
            lambda text: "0\n0\n" + text.split("\n", 2)[2].rpartition("\n1 0 0")[0],
            "holds no points",
        ),
        (lambda _: "1 2 3\n4 5 6\n", "line 1 of the header of scan 1 reads '1 2 3'"),
    ],
)
def test_what_cannot_be_read_gives_one_sentence(tmp_path, change, said):
    rows = ["1 0 0 0.25", "0 2 0 1", "0 0 1 0.5", "0 0 3 0"]
    text = ptx([(pose(0, [10, 20, 30]), rows)], (2, 2))
    path = tmp_path / "a.ptx"
    path.write_text(change(text) if said[:6] != "should" else "\n".join(text.split("\n")[:12]))
    with pytest.raises(FormatError, match=said) as caught:
        read(path)
    assert "\n" not in str(caught.value)
