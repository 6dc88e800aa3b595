"""Where compiled kernels are kept, and that an edit in an imported kernel is noticed."""

import shutil
import subprocess
import sys
from pathlib import Path

import dougong.kernels as kernels

KERNELS = Path(kernels.__file__).parent

BASE = "from dougong.kernels._jit import kernel\n@kernel\ndef base(x):\n    return x + {}\n"
USER = (
    "from dougong.kernels._jit import kernel\nfrom dougong.kernels.zz_base import base\n"
    "@kernel\ndef user(x):\n    return base(x) * 2\n"
)


def call(package: Path, cache: Path, **environment: str) -> float:
    # -B: Python itself takes a source of the same size and second for unchanged.
    code = "from dougong.kernels.zz_user import user; print(user(1.0))"
    run = subprocess.run(
        [sys.executable, "-B", "-c", code],
        env={"PYTHONPATH": str(package), "DOUGONG_CACHE_DIR": str(cache), **environment},
        capture_output=True,
        text=True,
        check=True,
    )
    return float(run.stdout)


def kernel_package(folder: Path) -> Path:
    room = folder / "dougong" / "kernels"
    room.mkdir(parents=True)
    (folder / "dougong" / "__init__.py").write_text("")
    for name in ("__init__.py", "_jit.py"):
        shutil.copy(KERNELS / name, room / name)
    (room / "zz_base.py").write_text(BASE.format(1))
    (room / "zz_user.py").write_text(USER)
    return room


def test_edit_of_an_imported_kernel_is_noticed(tmp_path):
    room = kernel_package(tmp_path)
    cache = tmp_path / "cache"
    assert call(tmp_path, cache) == 4.0
    assert any(cache.rglob("*.nbi"))
    (room / "zz_base.py").write_text(BASE.format(5))
    assert call(tmp_path, cache) == 12.0


def test_cache_can_be_switched_off_and_an_unwritable_one_is_survived(tmp_path):
    kernel_package(tmp_path)
    cache = tmp_path / "cache"
    assert call(tmp_path, cache, DOUGONG_NUMBA_CACHE="0") == 4.0
    assert not cache.exists()
    cache.write_text("a file where the folder should be")
    assert call(tmp_path, cache) == 4.0


def test_a_full_disk_under_the_cache_is_survived(tmp_path):
    """The compiled kernel is larger than a file may be here; it runs from memory."""
    kernel_package(tmp_path)
    code = (
        "import resource\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))\n"
        "from dougong.kernels.zz_user import user\n"
        "print(user(1.0))\n"
    )
    run = subprocess.run(
        [sys.executable, "-B", "-c", code],
        env={"PYTHONPATH": str(tmp_path), "DOUGONG_CACHE_DIR": str(tmp_path / "cache")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (run.returncode, run.stdout) == (0, "4.0\n"), run.stderr[-400:]
    assert call(tmp_path, tmp_path / "cache") == 4.0
