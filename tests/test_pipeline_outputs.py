"""Results appear whole or not at all."""

import json
import os
import platform
import subprocess
import sys

import pytest

from dougong.errors import InputError, OutputError
from dougong.formats import unfinished
from dougong.formats.atomic import replacing
from dougong.pipeline import outputs
from dougong.pipeline.result_folder import (
    refuse_inputs_in_result,
    refuse_other_result,
    result_folder,
)


def test_a_folder_appears_only_when_all_of_it_is_there(tmp_path):
    out = tmp_path / "result"
    with result_folder(out) as part:
        (part / "clouds").mkdir()
        (part / "clouds" / "a.laz").write_bytes(b"1")
        assert not out.exists()
    assert (out / "clouds" / "a.laz").read_bytes() == b"1"
    assert list(tmp_path.iterdir()) == [out]


def test_a_failed_job_leaves_no_folder_and_no_part(tmp_path):
    def job():
        with result_folder(tmp_path / "result") as part:
            (part / "half").write_text("x")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        job()
    assert list(tmp_path.iterdir()) == []


def test_writing_into_an_old_folder_keeps_files_of_others(tmp_path):
    out = tmp_path / "result"
    out.mkdir()
    (out / "notes.txt").write_text("mine")
    (out / "result.json").write_text("old")
    with result_folder(out) as part:
        (part / "result.json").write_text("new")
    assert (out / "notes.txt").read_text() == "mine"
    assert (out / "result.json").read_text() == "new"


def test_cancelling_removes_what_was_begun_and_keeps_what_was_there(tmp_path):
    finished = tmp_path / "a.laz"
    finished.write_text("old")
    job = result_folder(tmp_path / "result")
    part = job.__enter__()
    (part / "half").write_text("x")
    with unfinished.watched(finished):
        unfinished.part_of(finished).write_text("half")
        unfinished.remove_unfinished()
    assert [path.name for path in tmp_path.iterdir()] == ["a.laz"]
    assert finished.read_text() == "old"


def test_existing_results_are_refused_without_overwrite(tmp_path):
    path = tmp_path / "a.laz"
    path.touch()
    with pytest.raises(InputError, match=r"exists already.*--overwrite"):
        outputs.refuse_existing([path], overwrite=False)
    outputs.refuse_existing([path], overwrite=True)
    outputs.refuse_existing([tmp_path / "b.laz"], overwrite=False)


def test_json_is_whole_and_strict(tmp_path):
    path = tmp_path / "a.json"
    outputs.write_json(path, {"name": "塔", "value": 1.5})
    assert json.loads(path.read_text(encoding="utf-8")) == {"name": "塔", "value": 1.5}
    with pytest.raises(ValueError, match="JSON"):
        outputs.write_json(path, {"value": float("nan")})
    assert json.loads(path.read_text(encoding="utf-8"))["value"] == 1.5


def test_a_place_that_cannot_be_written_is_one_sentence(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="could not be written"):
        outputs.write_text(tmp_path / "file" / "a.json", "x")
    with (
        pytest.raises(OutputError, match="cannot be made"),
        result_folder(tmp_path / "file" / "out"),
    ):
        pass


def part_of_process(folder, process, host=None):
    path = folder / f".result.part-{host or platform.node()}-{process}"
    path.mkdir()
    return path


@pytest.mark.skipif(os.name != "posix", reason="processes are not asked for elsewhere")
def test_two_jobs_into_one_folder_do_not_mix(tmp_path):
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as other:
        theirs = part_of_process(tmp_path, other.pid)
        with (
            pytest.raises(OutputError, match=f"another dougong .process {other.pid}"),
            result_folder(tmp_path / "result"),
        ):
            pass
        assert theirs.is_dir()
        other.communicate(b"\n")
    with result_folder(tmp_path / "result") as part:
        (part / "a").touch()
    assert [path.name for path in tmp_path.iterdir()] == ["result"], "a killed job's rest is gone"


@pytest.mark.skipif(os.name != "posix", reason="processes are not asked for elsewhere")
def test_a_job_of_another_machine_is_not_taken_for_dead(tmp_path):
    theirs = part_of_process(tmp_path, 1, host="elsewhere")
    with (
        pytest.raises(OutputError, match=r"on elsewhere.*if it is gone, delete"),
        result_folder(tmp_path / "result"),
    ):
        pass
    assert theirs.is_dir()


@pytest.fixture
def dead():
    """The number of a process of this machine that has ended."""
    with subprocess.Popen([sys.executable, "-c", ""]) as process:
        pass
    return process.pid


def write_as_cloud(path):
    with replacing(path, expected_bytes=1) as sink:
        sink.write(b"x")


@pytest.mark.skipif(os.name != "posix", reason="processes are not asked for elsewhere")
@pytest.mark.parametrize(
    "write", [write_as_cloud, lambda path: outputs.write_json(path, {})], ids=["cloud", "books"]
)
def test_the_next_writer_of_a_file_clears_what_a_killed_one_left(tmp_path, dead, write):
    """Parts of 8 GB each stayed beside the output for good."""
    here = platform.node()
    for name in (f"o.laz.part-{here}-{dead}", f"o.laz.part-{here}-{os.getppid()}",
                 f"o.laz.part-elsewhere-{dead}", f"o.laz.part-{dead}", "o.laz.part-of-mine",
                 f"a.laz.part-{here}-{dead}"):  # fmt: skip
        (tmp_path / name).write_text("half")
    write(tmp_path / "o.laz")
    assert {path.name for path in tmp_path.iterdir()} == {
        "o.laz", f"o.laz.part-{here}-{os.getppid()}", f"o.laz.part-elsewhere-{dead}",
        f"o.laz.part-{dead}", "o.laz.part-of-mine", f"a.laz.part-{here}-{dead}",
    }  # fmt: skip


@pytest.mark.skipif(os.name != "posix", reason="processes are not asked for elsewhere")
def test_a_folder_of_use_meanwhile_goes_and_that_of_a_killed_job_too(tmp_path, dead):
    head = tmp_path / "tiles-o-"
    for mark in (f"{platform.node()}-{dead}", f"{platform.node()}-{os.getpid()}", "elsewhere-1"):
        (tmp_path / f"tiles-o-{mark}" / "deep").mkdir(parents=True)
    with unfinished.passing_folder(head) as folder:
        assert not folder.exists(), "our number, of an earlier life"
        (folder / "deep").mkdir(parents=True)
        unfinished.remove_unfinished()
        assert not folder.exists(), "cancelled"
        folder.mkdir()
    assert [path.name for path in tmp_path.iterdir()] == ["tiles-o-elsewhere-1"]


@pytest.mark.skipif(os.name != "posix", reason="processes are not asked for elsewhere")
def test_a_folder_of_work_has_one_user_at_a_time(tmp_path, dead):
    folder, here = tmp_path / "work" / "tiles-1", platform.node()
    mark = tmp_path / "work" / f"tiles-1.user-{here}-{os.getppid()}"
    with unfinished.sole_user(folder):
        (own,) = (tmp_path / "work").iterdir()
        with pytest.raises(OutputError, match="tiles-1 is being worked in by another"):
            unfinished.sole_user(folder).__enter__()  # a thread of this process, say
        assert own.exists()
    own.touch()  # our number, of an earlier life
    (tmp_path / "work" / f"tiles-1.user-{here}-{dead}").touch()
    with unfinished.sole_user(folder):
        assert list((tmp_path / "work").iterdir()) == [own]
        unfinished.remove_unfinished()
        assert not own.exists(), "cancelled"
    mark.touch()
    with pytest.raises(OutputError, match=rf"process {os.getppid()} on .* pass another --work;"):
        unfinished.sole_user(folder).__enter__()
    assert list((tmp_path / "work").iterdir()) == [mark]


def test_a_result_folder_that_is_a_file_is_refused_at_once(tmp_path):
    (tmp_path / "result").touch()
    with (
        pytest.raises(OutputError, match="is a file, and the result is a folder"),
        result_folder(tmp_path / "result"),
    ):
        pass


def test_a_step_that_cannot_be_kept_is_one_sentence(tmp_path, monkeypatch):
    import numpy as np

    from dougong.cloud import Cloud
    from dougong.pipeline.books import Books
    from dougong.pipeline.steps import Filtered
    from dougong.pipeline.store import Store

    def full(file, **_):
        file.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("numpy.savez", full)
    codes = np.zeros(1, np.uint8)
    cloud = Cloud.from_points([[0.0, 0, 0]])
    step = Filtered(cloud=cloud, codes=codes, ground_class=codes, stages=())
    store = Store.beside(tmp_path / "out")
    with pytest.raises(OutputError, match=r"work could not be written: No space left.*--work"):
        store.save("key", Books.of(step, ()))
    assert list((tmp_path / "out.work").iterdir()) == []


def test_work_is_done_in_no_folder_of_the_user(tmp_path):
    """A folder `run` in --work, and one called RESULT.work, were emptied: inputs were lost."""
    from dougong.pipeline.store import Store
    from dougong.tiles.folder import LocalFolder

    out = tmp_path / "result"
    mine = [tmp_path / "run" / "scan.laz", tmp_path / "result.work" / "notes.txt"]
    for file in mine:
        file.parent.mkdir()
        file.write_text("mine")
    kept = Store.kept(LocalFolder(tmp_path), out)
    with kept.claimed(), outputs.scratch_folder(kept.of_run) as scratch:
        (scratch / "half").write_text("x")
    kept.finish()
    beside = Store.beside(out)
    with pytest.raises(OutputError, match=r"result\.work .*dougong did not put there"):
        beside.claimed().__enter__()
    with (
        pytest.raises(OutputError, match="did not put there"),
        outputs.scratch_folder(tmp_path / "run"),
    ):
        pass
    assert sorted(tmp_path.rglob("*")) == sorted([*mine, *(file.parent for file in mine)])


def test_a_killed_run_leaves_a_folder_that_the_next_one_uses(tmp_path):
    from dougong.pipeline.store import Store

    store = Store.beside(tmp_path / "result")
    killed = [store.claimed(), outputs.scratch_folder(store.of_run)]
    for folder in killed:
        folder.__enter__()
    (store.of_run / "half").write_text("x")
    with store.claimed(), outputs.scratch_folder(store.of_run) as scratch:
        assert not (scratch / "half").exists()
    assert list(tmp_path.iterdir()) == []


def test_full_clouds_and_distances_of_an_earlier_result_go(tmp_path):
    out = tmp_path / "result"
    for name in ("full/st0.laz", "full/st0.laz.json", "full/keep.txt", "distances/scan.laz"):
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text("old")
    result = {
        "clouds": [{"name": "scan"}],
        "full_resolution": {"files": [{"file": "full/st0.laz"}]},
    }
    outputs.write_json(out / "result.json", result)
    with result_folder(out) as part:
        (part / "result.json").write_text("{}")
    assert sorted(f.name for f in out.rglob("*") if f.is_file()) == ["keep.txt", "result.json"]


def test_an_error_names_the_folder_that_the_user_named(tmp_path):
    def job():
        with result_folder(tmp_path / "result") as part:
            raise OutputError(f"The disk is full: {part / 'a.laz'} needs 3 MB.")

    with pytest.raises(OutputError) as caught:
        job()
    assert str(tmp_path / "result" / "a.laz") in str(caught.value)
    assert ".part-" not in str(caught.value)


def test_clouds_of_an_earlier_result_do_not_stay_beside_the_new_ones(tmp_path):
    """A pose of last week's run would pass for one of today's."""
    out = tmp_path / "result"

    def result(*names):
        with result_folder(out) as part:
            for name in names:
                for folder, suffix in (("clouds", "laz"), ("registrations", "json")):
                    (part / folder).mkdir(exist_ok=True)
                    (part / folder / f"{name}.{suffix}").write_text(name)
            document = {"clouds": [{"name": name} for name in names]}
            outputs.write_json(part / "result.json", document)

    result("scan", "tower.v2")
    (out / "clouds" / "mine.txt").write_text("notes")
    result("scan")
    found = sorted(str(p.relative_to(out)) for p in out.rglob("*") if p.is_file())
    assert found == ["clouds/mine.txt", "clouds/scan.laz", "registrations/scan.json", "result.json"]


def files_in(folder):
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())


def test_a_result_is_made_on_the_disk_where_it_ends(tmp_path):
    """Beside a mount point, and beside a link, is another disk: the last rename failed."""
    from dougong.pipeline.store import Store

    disk, out = tmp_path / "disk" / "there", tmp_path / "result"
    disk.mkdir(parents=True)
    out.symlink_to(disk)
    with result_folder(out) as part:
        assert part.parent.samefile(disk)
        (part / "result.json").write_text("{}")
    assert files_in(disk) == ["result.json"]
    assert Store.beside(out).scratch == (tmp_path / "disk" / "there.work").resolve()
    out.unlink()
    out.symlink_to(tmp_path / "disk" / "new")
    with result_folder(out) as part:
        (part / "a").touch()
    assert out.is_symlink()
    assert files_in(tmp_path / "disk") == ["new/a", "there/result.json"]


def test_work_of_a_mounted_folder_is_inside_it(tmp_path, monkeypatch):
    from dougong.pipeline.store import Store

    monkeypatch.setattr("os.path.ismount", lambda path: path == tmp_path)
    assert Store.beside(tmp_path).scratch.parent == tmp_path


@pytest.mark.parametrize("is_there", [False, True])
def test_a_finished_result_that_cannot_be_moved_stays(tmp_path, monkeypatch, is_there):
    out = tmp_path / "result"
    if is_there:
        out.mkdir()
    rename = type(out).rename

    def refused(path, target):
        if ".part-" in str(path.relative_to(tmp_path)) and target.name in ("result", "b"):
            raise OSError(18, "Invalid cross-device link")
        return rename(path, target)

    def job():
        with result_folder(out) as part:
            (part / "a").touch()
            (part / "b").write_text("hours of work")

    monkeypatch.setattr(type(out), "rename", refused)
    monkeypatch.setattr(type(out), "replace", refused)
    with pytest.raises(OutputError, match=r"cross-device.*result\.finished: move them"):
        job()
    monkeypatch.undo()
    with result_folder(out):
        pass
    (kept,) = tmp_path.rglob("b")
    assert kept.read_text() == "hours of work"
    assert ".part-" not in str(kept.relative_to(tmp_path))


def test_exports_of_an_earlier_pose_do_not_stay_beside_a_new_one(tmp_path):
    """A wrong pose would be loaded elsewhere, beside a registration that says `failed`."""
    out = tmp_path / "result"
    out.mkdir()
    exports = [
        f"registration{end}" for end in (".cloudcompare.txt", ".pdal.json", ".metashape.xml")
    ]
    for name in (*exports, "distances.laz", "registration.notes.txt"):
        (out / name).write_text("old")
    outputs.write_json(out / "registration.json", {"matrix": None})
    with result_folder(out) as part:
        outputs.write_json(part / "registration.json", {"matrix": None})
    assert files_in(out) == ["registration.json", "registration.notes.txt"]


def run_of(out, name="scan"):
    """A folder as a demo leaves it."""
    for file in ("merged.copc.laz", f"clouds/{name}.laz", f"clouds/{name}.notes.txt", "demo.json",
                 f"registrations/{name}.pdal.json", "scene/lidar.laz", "report.html"):  # fmt: skip
        (out / file).parent.mkdir(parents=True, exist_ok=True)
        (out / file).write_text("old")
    outputs.write_json(out / "result.json", {"clouds": [{"name": name}]})


def test_a_folder_holds_one_result(tmp_path):
    """A demo's errors against its truth were shown as those of another run."""
    out = tmp_path / "result"
    run_of(out)
    with result_folder(out) as part:
        outputs.write_json(part / "registration.json", {"matrix": None})
    assert files_in(out) == ["clouds/scan.notes.txt", "registration.json", "scene/lidar.laz"]
    with result_folder(out) as part:
        outputs.write_json(part / "result.json", {"clouds": []})
    assert files_in(out) == ["clouds/scan.notes.txt", "result.json", "scene/lidar.laz"]


@pytest.mark.parametrize("name", ["result.json", "registration.json", "report.html"])
def test_no_command_writes_over_the_result_of_another(tmp_path, name):
    (tmp_path / name).touch()
    with pytest.raises(InputError, match=f"{name} exists already"):
        refuse_other_result(tmp_path, overwrite=False)
    refuse_other_result(tmp_path, overwrite=True)


def test_a_result_that_is_replaced_is_no_input(tmp_path):
    run_of(tmp_path)
    refuse_inputs_in_result([tmp_path / "scene" / "lidar.laz"], tmp_path)
    with pytest.raises(InputError, match=r"scan\.laz is part of the result in .*that is replaced"):
        refuse_inputs_in_result([tmp_path / "clouds" / "scan.laz"], tmp_path)
