"""The report: what it says, what it draws, and that it is one page that escapes everything."""

import re
from dataclasses import replace
from html.parser import HTMLParser
from shutil import copyfile

import numpy as np
import pytest

from dougong.cloud import Cloud
from dougong.errors import InputError
from dougong.formats import in_system, write
from dougong.formats.units import as_wkt
from dougong.pipeline.provenance import sha256
from dougong.registration.checks import checks_document
from dougong.registration.control import Control
from dougong.registration.control_solve import ControlPoints
from dougong.report import build, rebuild
from dougong.report.documents import in_metres, replaced_inputs
from dougong.report.drawing import View, draw_dots, draw_surface, height_colours, oblique_view
from dougong.report.figures import find_place, overview, slices
from dougong.report.layers import BLUE, COLOURS, Layer, pair_layers, rigid_inverse, run_layers
from dougong.report.links import network_rows
from dougong.report.model import flat, from_registration, from_run
from dougong.report.plates import length_text, line_chart, plate, round_length
from dougong.report.render import environment, render
from dougong.report.streaming import items_of
from dougong.report.verdict import NO_CHECKS, accuracy

TOP = View(
    right=np.array([1.0, 0, 0]),
    up=np.array([0, 1.0, 0]),
    towards=np.array([0, 0, 1.0]),
    centre=np.zeros(3),
    width_m=10.0,
    width_px=100,
    height_px=80,
)


def registration(status="ok", name="scan", **changes):
    matrix = np.eye(4)
    matrix[:3, 3] = [492560.46131, 2993295.91742, 31.755]
    document = {
        "status": status,
        "source": name,
        "target": "drone",
        "matrix": None if status == "failed" else matrix.tolist(),
        "scale": 1.0,
        "dof": 6,
        "coarse": {
            "method": "plan",
            "hypotheses": [
                {"matrix": matrix.tolist(), "score": 0.8, "yaw_deg": 12.0},
                {"matrix": matrix.tolist(), "score": 0.76, "yaw_deg": -168.0},
            ],
            "margin": 0.05,
        },
        "probability": 0.51,
        "reason": "two poses <fit> equally well",
        "fine": {
            "method": "point-to-plane", "iterations": 4, "stopped": "small step",
            "fitness": 0.6, "inlier_rmse_m": 0.0123, "max_distance_m": 0.06,
            "overlap_source": 0.58, "overlap_target": 0.44,
            "history": [{"inlier_rmse_m": value} for value in (0.2, 0.05, 0.02, 0.0123)],
        },
        "covariance": (np.eye(6) * 1e-6).tolist(),
        "covariance_about": [0.0, 0.0, 0.0],
        "unobservable": [{"vector": [0, 0, 1, 0, 0, 0], "text": "the turn about the vertical"}],
        "checks": None,
        "seconds": {"coarse": 1.0},
        "dougong": "0.1.0",
        "parameters": {"coarse": "auto"},
        "inputs": [{"path": "scan.laz", "sha256": "ab" * 32, "points": 10}],
        "notes": ["12 of 3000 rows had no finite coordinates & were dropped"],
        "software": {"dougong": "0.1.0", "python": "3", "platform": "p", "libraries": {"a": "1"}},
        "peak_memory_bytes": None,
    }  # fmt: skip
    return document | changes


def run_result(*documents):
    stage = {"name": "statistical", "points_in": 100, "points_out": 90, "reduction": 0.1,
             "seconds": 0.5}  # fmt: skip
    names = ["drone", *(document["source"] for document in documents)]
    status = "ok" if all(document["status"] == "ok" for document in documents) else "ambiguous"
    return registration() | {
        "status": status,
        "project": "Great <Hall>",
        "reference": "drone",
        "clouds": [
            {"name": name, "kind": "lidar", "files": ["a.laz"], "points_in": 100, "points_out": 90,
             "reduction": 0.1, "stages": [stage], "frame": "of the reference"}
            for name in names
        ],
        "registrations": list(documents),
        "merged": {"points": 90, "clouds": ["drone"]},
        "seconds": {"total": 3.0},
        "result_hash": "cd" * 32,
        "parameters": {"register": {"coarse": "auto"}},
    }  # fmt: skip


def building(seed, shift=0.0):
    rng = np.random.default_rng(seed)
    walls = [
        np.column_stack([rng.uniform(-6, 6, 4000), np.full(4000, y), rng.uniform(0, 4, 4000)])
        for y in (-4.0, 4.0)
    ]
    sides = [
        np.column_stack([np.full(3000, x), rng.uniform(-4, 4, 3000), rng.uniform(0, 4, 3000)])
        for x in (-6.0, 6.0)
    ]
    floor = np.column_stack([rng.uniform(-9, 9, (8000, 2)), np.zeros(8000)])
    return np.vstack([*walls, *sides, floor]) + [shift, 0, 0]


@pytest.fixture(scope="module")
def layers():
    first, second = building(0), building(1)
    return [
        Layer(name="scan", colour=COLOURS[0], after=first, before=first[:, [1, 0, 2]],
              is_reference=False, is_sure=True),
        Layer(name="drone", colour=BLUE, after=second, before=second, is_reference=True,
              is_sure=True),
    ]  # fmt: skip


@pytest.fixture(scope="module")
def text(layers):
    return render(from_run(run_result(registration()), None), layers)


class Page(HTMLParser):
    """Tags in order, and whether each closes the one it should."""

    VOID = frozenset({"meta", "link", "br", "wbr", "image", "path", "rect", "circle", "polyline"})

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.words = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)


def test_the_page_is_whole_escaped_and_asks_for_nothing(text):
    page = Page(text)
    assert page.open == []
    assert "Great <Hall>" in "".join(page.words)
    assert "<Hall>" not in text
    assert "<fit>" not in text
    assert not [tag for tag, _ in page.tags if tag in ("link", "iframe")]
    assert not [tag for tag, attributes in page.tags if tag == "script" and "src" in attributes]
    policy = next(
        a["content"] for t, a in page.tags if a.get("http-equiv") == "Content-Security-Policy"
    )
    assert policy.startswith("default-src 'none'")
    assert "http" not in policy
    links = [
        value for _, attrs in page.tags for key, value in attrs.items() if key in ("src", "href")
    ]
    assert links
    assert all(value.startswith("data:image/png;base64,") for value in links)
    assert "url(" not in text
    assert "prefers-color-scheme: dark" in text
    assert "@media print" in text


def test_pictures_have_words_for_those_who_cannot_see_them(text):
    page = Page(text)
    pictures = [attrs for tag, attrs in page.tags if tag == "svg" and "aria-hidden" not in attrs]
    assert len(pictures) >= 9
    assert all(attrs["role"] == "img" and attrs["aria-label"] for attrs in pictures)


@pytest.mark.parametrize(
    ("status", "word"),
    [("ok", "Registered"), ("ambiguous", "Ambiguous"), ("failed", "Not registered")],
)
def test_the_verdict_is_a_word_and_a_shape_not_only_a_colour(status, word):
    report = from_registration(registration(status))
    assert report.verdict.word == word
    text = render(report, [])
    verdict = re.search(r'<section class="verdict.*?</section>', text, re.S)[0]
    assert word in verdict
    assert verdict.count('<svg class="icon"') == 1
    assert "Two poses &lt;fit&gt; equally well." in verdict


def test_the_shapes_of_the_verdicts_differ():
    icons = {
        re.search(
            r'<svg class="icon".*?</svg>', render(from_registration(registration(status)), [])
        )[0]
        for status in ("ok", "ambiguous", "failed")
    }
    assert len(icons) == 3


def test_every_key_number_has_a_definition_and_no_grade_is_stated():
    demo = {"tre95_m": 0.0048, "rotation_error_deg": 0.0043, "bending_floor95_m": 0.0119,
            "verdict": "accurate"}  # fmt: skip
    one = run_result(registration())
    for report in (from_run(one, None), from_run(one, demo), from_run(run_result(), None)):
        assert len(report.key_numbers) == 3
        assert all(len(number.definition) > 15 for number in report.key_numbers)
        assert "no accuracy grade is stated" in report.checks[0]
    shown = from_run(one, demo).key_numbers
    assert [(number.value, number.unit) for number in shown] == [
        ("4.8", "mm"), ("0.0043", "deg"), ("11.9", "mm"),
    ]  # fmt: skip


def test_the_worst_link_speaks_for_several():
    better = registration(name="good")
    better["fine"] = better["fine"] | {"inlier_rmse_m": 0.005, "overlap_source": 0.9}
    report = from_run(run_result(registration("ambiguous"), better), None)
    assert report.verdict.tone == "unsure"
    assert "1 of 2 clouds" in report.verdict.sentence
    assert "holds only: drone" in report.verdict.sentence
    rmse, overlap, _ = report.key_numbers
    assert (rmse.value, overlap.value) == ("12.3", "58")
    assert "worst" in rmse.definition


def test_transforms_keep_their_digits():
    report = from_registration(registration())
    assert report.links[0].matrix[0] == (
        "1.0000000000",
        "0.0000000000",
        "0.0000000000",
        "492560.4613",
    )
    assert from_registration(registration("failed")).links[0].matrix == ()


def test_a_registration_without_a_fine_fit_can_be_shown():
    text = render(from_registration(registration(fine=None, covariance=None)), [])
    assert "none" in text


def test_nested_parameters_become_dotted_names():
    lidar = {"voxel_m": 0.005, "depth": None, "holes": [], "is_on": True}
    rows = flat({"filter": {"lidar": lidar}, "files": ["a", "b"]})
    assert rows == [
        ("filter.lidar.voxel_m", "0.005"), ("filter.lidar.depth", "not set"),
        ("filter.lidar.holes", "none"), ("filter.lidar.is_on", "true"), ("files", "a, b"),
    ]  # fmt: skip


def test_long_names_of_parameters_break_behind_their_parts():
    shown = environment().from_string("{{ name|breakable }}").render(name="filter.<b>.voxel_m")
    assert shown == "filter.<wbr>&lt;b&gt;.<wbr>voxel_<wbr>m"


def test_a_folder_without_a_result_is_one_sentence(tmp_path):
    with pytest.raises(InputError, match=r"no result\.json"):
        build(tmp_path)


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("result.json", "{", "result.json is no JSON text: line 1, column 2: "),
        ("result.json", "[]", "result.json holds a list, expected an object. Give the command"),
        ("result.json", '{"clouds": 1}', "result.json has no registrations and no inputs and no"),
        ("registration.json", "\xff", "registration.json is no UTF-8 text. Give the command"),
        (
            "registration.json",
            '{"status": "ok", "matrix": 1, "source": 1, "target": 1, "inputs": []}',
            "are not as this dougong writes them",
        ),
    ],
)
def test_a_document_that_was_changed_is_one_sentence(tmp_path, name, text, said):
    (tmp_path / name).write_text(text, encoding="latin-1")
    with pytest.raises(InputError) as caught:
        rebuild(tmp_path)
    assert said in str(caught.value)
    assert "with --overwrite." in str(caught.value)
    if name == "result.json":
        with pytest.raises(InputError, match=re.escape(said)):
            items_of([tmp_path])


def test_an_input_that_is_another_file_by_now_is_said(tmp_path):
    write(Cloud.from_points(np.eye(3)), tmp_path / "a.laz")
    inputs = [{"path": str(tmp_path / "a.laz"), "sha256": sha256(tmp_path / "a.laz")}]
    gone = {"path": str(tmp_path / "gone.laz"), "sha256": ""}
    assert replaced_inputs({"inputs": [*inputs, gone]}) == []
    write(Cloud.from_points(np.eye(3) + 1), tmp_path / "a.laz", overwrite=True)
    (note,) = replaced_inputs({"inputs": inputs})
    assert "a.laz is not the file that was registered" in note


def test_a_registration_whose_inputs_are_gone_says_so(tmp_path):
    import json

    document = registration()
    document["inputs"] = [document["inputs"][0], document["inputs"][0] | {"path": "gone.laz"}]
    (tmp_path / "registration.json").write_text(json.dumps(document))
    assert "nothing could be drawn" in build(tmp_path).read_text(encoding="utf-8")


def test_the_nearer_point_hides_the_farther_one_in_any_order():
    points = np.array([[0.0, 0, 0], [0.0, 0, 1]])
    colours = np.array([[255, 0, 0], [0, 0, 255]], np.uint8)
    for order in ([0, 1], [1, 0]):
        image = draw_surface(points[order], colours[order], TOP)
        assert image.shape == (80, 100, 4)
        seen = image[image[..., 3] > 30]
        assert len(seen)
        assert (seen[:, 2] > 150).all()
        assert (seen[:, 0] < 20).all()


def test_points_land_where_the_view_says():
    image = draw_surface(np.array([[2.0, 3.0, 0.0]]), np.full((1, 3), 200, np.uint8), TOP)
    row, column = (int(np.median(axis)) for axis in np.nonzero(image[..., 3]))
    assert abs(column - 70) <= 1
    assert abs(row - 10) <= 1


def test_edges_are_darkened_and_flat_ground_is_not():
    grid = np.stack(np.meshgrid(np.linspace(-5, 5, 200), np.linspace(-4, 4, 160)), -1).reshape(
        -1, 2
    )
    height = np.where(grid[:, 0] > 0, 3.0, 0.0)
    flat_ground = draw_surface(
        np.column_stack([grid, 0 * height]), np.full((len(grid), 3), 200, np.uint8), TOP
    )
    step = draw_surface(
        np.column_stack([grid, height]), np.full((len(grid), 3), 200, np.uint8), TOP
    )
    assert flat_ground[20:60, 20:80, 0].min() >= 198
    assert step[40, 48, 0] < 170
    assert step[40, 53:90, 0].min() >= 198


def test_nothing_is_drawn_of_nothing():
    none = np.zeros((0, 3))
    assert draw_surface(none, np.zeros((0, 3), np.uint8), TOP)[..., 3].max() == 0
    assert draw_dots([(none, BLUE)], TOP)[..., 3].max() == 0


def test_two_layers_in_one_place_mix_and_alone_keep_their_colour():
    here, there = np.array([[0.0, 0, 0]]), np.array([[3.0, 0, 0]])
    image = draw_dots([(here, (200, 0, 0)), (np.vstack([here, there]), (0, 0, 200))], TOP, dot=6)
    assert np.abs(image[40, 50, :3].astype(int) - [100, 0, 100]).max() < 12
    assert np.abs(image[40, 80, :3].astype(int) - [0, 0, 200]).max() < 5


def test_the_box_fits_into_the_oblique_view():
    low, high = np.array([-5.0, -20, 0]), np.array([5.0, 20, 9])
    for azimuth in (0, 35, 200):
        view = oblique_view(low, high, azimuth, 30, 400, 300)
        corners = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T
        column, row, _ = view.project(corners)
        assert column.min() > 0
        assert column.max() < 400
        assert row.min() > 0
        assert row.max() < 300


def test_heights_get_colours_that_rise():
    colours = height_colours(np.linspace(0, 10, 50)).astype(int)
    assert (np.diff(colours.sum(axis=1)) >= -6).all()
    assert colours[-1].sum() > colours[0].sum() + 200
    assert height_colours(np.zeros(3)).shape == (3, 3)


def test_the_slices_find_walls_and_their_direction(layers):
    place = find_place(layers)
    assert place.yaw_deg in (0.0, 88.0, 2.0)
    assert abs(place.floor) < 0.3
    titles = [figure.title for figure in slices(layers, place)]
    assert titles == [
        "Plan slice", "Enlarged", "Section along the walls", "Enlarged",
        "Section across the walls", "Enlarged",
    ]  # fmt: skip
    assert [figure.title for figure in overview(layers, place)] == ["Before", "After", "Height"]


def test_one_cloud_has_no_before_and_after(layers):
    place = find_place(layers[1:])
    assert [figure.title for figure in overview(layers[1:], place)] == ["Height"]


def test_going_back_through_a_matrix_is_exact_at_map_coordinates():
    angle = 0.7
    matrix = np.eye(4)
    matrix[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    matrix[:3, 3] = [5e5, 4e6, 30]
    own = np.array([[1.0, 2.0, 3.0], [10.0, -4.0, 0.5]])
    origin = np.array([500_000.0, 4_000_000.0, 30.0])
    target = own @ matrix[:3, :3].T + (matrix[:3, 3] - origin)
    back, shift = rigid_inverse(matrix, origin)
    np.testing.assert_allclose(target @ back.T + shift, own, atol=1e-8)


US_FOOT = 1200 / 3937


@pytest.fixture
def in_feet(tmp_path):
    """A scan in metres and the same points in a map of feet, with the matrix between the files."""
    matrix = np.eye(4)
    matrix[:3, :3] = np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]]) / US_FOOT
    matrix[:3, 3] = [6_000_000.0, 2_000_000.0, 100.0]
    own = building(0)
    there = own @ matrix[:3, :3].T + matrix[:3, 3]
    files = [tmp_path / "scan.laz", tmp_path / "drone.laz", tmp_path / "bare.laz"]
    write(Cloud.from_points(own), files[0])
    write(in_system(Cloud.from_points(there), "EPSG:2227"), files[1])
    write(Cloud.from_points(there), files[2])
    frames = {
        "source_frame": {"crs_wkt": None, "unit_m": [1.0, 1.0, 1.0]},
        "target_frame": {"crs_wkt": as_wkt("EPSG:2227"), "unit_m": [US_FOOT] * 3},
    }
    inputs = [{"path": str(path), "sha256": "", "points": len(own)} for path in files]
    poses = [{"matrix": matrix.tolist(), "score": 0.8, "yaw_deg": 37.0}]
    document = registration(
        matrix=matrix.tolist(),
        coarse={"method": "plan", "hypotheses": poses, "margin": 0.5},
        **frames,
    )
    return document, inputs, own


@pytest.mark.parametrize("target", [1, 2], ids=["named by the file", "named by the user"])
def test_a_pair_in_feet_is_drawn_in_metres(in_feet, target):
    """Its matrix leads to feet and the clouds are drawn in metres: both lay far from each other."""
    document, inputs, own = in_feet
    drawn = in_metres(document | {"inputs": [inputs[0], inputs[target]]})
    source, reference = pair_layers(drawn)
    np.testing.assert_allclose(source.after, reference.after, atol=0.001)
    np.testing.assert_allclose(np.ptp(reference.after[:, 2]), np.ptp(own[:, 2]), atol=0.001)
    pose = np.array(drawn["coarse"]["hypotheses"][0]["matrix"])
    np.testing.assert_allclose(np.linalg.det(pose[:3, :3]), 1.0)


@pytest.mark.parametrize("is_sure", [True, False])
def test_a_run_in_feet_is_drawn_in_metres(in_feet, tmp_path, is_sure):
    document, inputs, own = in_feet
    (tmp_path / "clouds").mkdir()
    copyfile(inputs[1]["path"], tmp_path / "clouds" / "drone.laz")
    copyfile(inputs[1 if is_sure else 0]["path"], tmp_path / "clouds" / "scan.laz")
    result = run_result(document) | {
        "clouds": [{"name": name, "points_out": len(own)} for name in ("drone", "scan")],
        "merged": {"clouds": ["drone", "scan"] if is_sure else ["drone"]},
    }
    source, reference = run_layers(tmp_path, in_metres(result))
    np.testing.assert_allclose(source.after, reference.after, atol=0.001)
    centred = own - own.mean(axis=0)
    np.testing.assert_allclose(source.before - source.before.mean(axis=0), centred, atol=0.001)


@pytest.mark.parametrize(
    ("metres", "bar", "text"),
    [(23.0, 20.0, "20 m"), (0.7, 0.5, "50 cm"), (1.0, 1.0, "1 m"), (0.0061, 0.005, "5 mm")],
)
def test_scale_bars_are_round(metres, bar, text):
    assert round_length(metres) == pytest.approx(bar)
    assert length_text(round_length(metres)) == text


def test_a_plate_escapes_its_words_and_its_bar_is_to_scale():
    image = draw_surface(np.zeros((1, 3)), np.zeros((1, 3), np.uint8), TOP)
    svg = plate(image, TOP, 'a "b" <c>')
    assert 'aria-label="a &quot;b&quot; &lt;c>"' in svg
    start, end = re.search(r'class="bar" d="M(\d+) \S+H([\d.]+)', svg).groups()
    assert float(end) - float(start) == pytest.approx(2.0 / TOP.pixel_m)


def test_a_chart_ends_at_its_last_value():
    svg = line_chart(np.array([4.0, 2.0, 1.0]), "mm", "fit")
    points = [
        tuple(map(float, pair.split(","))) for pair in re.search(r'points="([^"]+)', svg)[1].split()
    ]
    heights = [y for _, y in points]
    assert heights == sorted(heights)
    assert len(points) == 3


def test_a_cloud_in_millimetres_beside_one_in_metres_is_reported_all_the_same(layers):
    first, second = layers[:2]
    tiny_unit = replace(first, before=1000.0 * first.before, after=first.after[:0], is_placed=False)
    titles = [figure.title for figure in overview([tiny_unit, second], find_place([second]))]
    assert "Before" not in titles
    assert "Height" in titles


def certificate(checks, **changes):
    """Return the words of the printed certificate of one registration with such `checks`."""
    html = render(from_registration(registration(checks=checks, **changes)), [])
    part = re.search(r'<section class="certificate".*?</section>', html, re.S)[0]
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", part)), html


def surveyed(checks, count=20):
    """Return the checks of points 5 mm off, one of the control points bad."""
    rng = np.random.default_rng(4)
    target = rng.uniform(-20, 20, (count, 3))
    source = target + rng.normal(0, 0.005, target.shape)
    source[2] += 0.4
    points = ControlPoints(
        names=tuple(f"P{k}" for k in range(count)),
        source=source,
        target=target,
        sigma_m=np.full(count, 0.005),
        is_check=np.arange(count) >= count - checks,
    )
    used = ~points.is_check
    used[2] = False
    control = Control(points=points, used=used, T_target_source=None)
    return checks_document(control, None, np.eye(4))


def test_the_certificate_names_the_check_error_the_grade_and_the_bad_point():
    words, html = certificate(surveyed(checks=8))
    assert "check RMSE (8 held-out points)" in words
    assert "left out" in re.search(r"P2 .{0,60}", words)[0]
    assert "8 points with the largest residuals of 20" in words
    assert re.search(r"LOA\d0 \(USIBD\)", html)


def test_the_certificate_states_no_grade_without_check_points():
    words, html = certificate(surveyed(checks=0))
    assert "none is stated: no check points were held out" in words
    assert not re.search(r"LOA\d0 \(USIBD\)", html)


def test_check_points_that_could_not_be_used_are_told_from_none():
    """A failed registration was said to have been given no check points."""
    unused = registration("failed", checks=surveyed(checks=8) | {"check": None, "level": None})
    missed = {"required_level": "LOA20", "is_reached": False}
    given, required = accuracy([unused], missed)
    assert given.startswith("scan: 8 check points had no pose to be measured at")
    assert required == "The required level, LOA20, is NOT reached."
    assert accuracy([registration()], missed) == (NO_CHECKS, required)
    assert "lie" in accuracy([registration(checks=surveyed(checks=8))], None)[0]


def test_the_certificate_says_what_a_searched_scale_is_worth():
    search = {"cloud": "drone", "metres_per_unit": 0.37, "sigma_ln": 7e-5, "control_points": 0}
    words, _ = certificate(None, scale_search=search)
    assert "searched: one unit of drone is 0.37 m (sigma 0.007 %)" in words
    assert "not observable (scan) the turn about the vertical" in words


def test_a_link_that_the_others_contradict_is_not_shown_as_registered():
    link = {
        "source": "c", "target": "b", "status": "ok", "overlap": 0.5, "is_checked": True,
        "is_left_out": True, "weight": 0.0, "loop_error_m": 0.65, "loop_error_deg": 3.0,
    }  # fmt: skip
    (row,) = network_rows({"links": [link]})
    assert (row["tone"], row["word"]) == ("bad", "Left out")
    assert row["loop"] == "650.0 mm, 3.000 deg"
    assert network_rows(None) == []
