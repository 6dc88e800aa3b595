"""The only file that names Numba's compile options, and where compiled kernels are kept.

Numba's on-disk cache does not notice an edit in a kernel file that another one imports, so each
kernel module gets a cache folder named by the hash of its own source and of every kernel module
it imports. The folder lies in the user's cache directory; where nothing is writable, or the disk is
full, the kernels compile in memory (``DOUGONG_NUMBA_CACHE=0`` asks for that).
"""

import ast
import hashlib
import os
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numba

P = ParamSpec("P")
R = TypeVar("R")

_HERE = Path(__file__).parent
_PACKAGE = __package__
# Sums may be re-ordered so that reductions vectorise; NaN and infinity keep their meaning.
_REASSOCIATE = {"reassoc", "contract", "nsz", "arcp"}


def cache_root() -> Path:
    """Return the folder under which compiled kernels are kept."""
    if "DOUGONG_CACHE_DIR" in os.environ:
        return Path(os.environ["DOUGONG_CACHE_DIR"])
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "dougong"
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", str(Path.home()))) / "dougong"
    return Path(os.environ.get("XDG_CACHE_HOME", str(Path.home() / ".cache"))) / "dougong"


@cache
def _is_writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


@cache
def _sources(module: str) -> frozenset[str]:
    """Return the names of `module` and of every kernel module it imports, however deep."""
    found = {module}
    for node in ast.walk(ast.parse((_HERE / f"{module}.py").read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(f"{_PACKAGE}."):
            found |= _sources((node.module or "").rsplit(".", 1)[1])
    return frozenset(found)


@cache
def _cache_folder(module: str) -> Path | None:
    """Return where the compiled kernels of `module` belong; None: compile in memory."""
    if os.environ.get("DOUGONG_NUMBA_CACHE", "1") != "1":
        return None
    digest = hashlib.sha256(numba.__version__.encode())
    for name in sorted(_sources(module)):
        digest.update((_HERE / f"{name}.py").read_bytes())
    folder = cache_root() / "kernels" / f"{module}-{digest.hexdigest()[:16]}"
    return folder if _is_writable(folder) else None


def _compile(
    func: Callable[P, R], fastmath: bool | set[str], forceinline: bool = False
) -> Callable[P, R]:
    module = func.__module__
    folder = _cache_folder(module.rsplit(".", 1)[1]) if module.startswith(f"{_PACKAGE}.") else None
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = str(folder or "")
    try:
        compiled: Callable[P, R] = numba.njit(
            cache=folder is not None,
            nogil=True,
            error_model="numpy",
            fastmath=fastmath,
            forceinline=forceinline,
        )(func)
    finally:
        numba.config.CACHE_DIR = before
    if folder is not None:
        _forgive_a_full_disk(compiled)
    return compiled


def _forgive_a_full_disk(compiled: Any) -> None:
    """Let a kernel that cannot be stored (full disk, quota) run all the same, from memory."""
    store = compiled._cache.save_overload

    def save_overload(signature: Any, data: Any) -> None:
        # Numba writes beside and renames, and takes an index without its data for a miss.
        with suppress(OSError):
            store(signature, data)

    compiled._cache.save_overload = save_overload


def kernel(func: Callable[P, R]) -> Callable[P, R]:
    """Compile a serial kernel: lazy types, cached on disk, GIL released, exact arithmetic."""
    return _compile(func, fastmath=False)


def inlined_kernel(func: Callable[P, R]) -> Callable[P, R]:
    """Compile a kernel that is put into those that call it: for the innermost walks.

    Left to itself the compiler calls the larger ones, and a search takes a tenth longer.
    """
    return _compile(func, fastmath=False, forceinline=True)


def summing_kernel(func: Callable[P, R]) -> Callable[P, R]:
    """Compile a kernel whose float sums may be re-ordered (NaN-safe); the same on each run."""
    return _compile(func, fastmath=_REASSOCIATE)


def least_kernel(func: Callable[P, R]) -> Callable[P, R]:
    """Compile a kernel that takes the least of numbers, none of them NaN, in any order."""
    return _compile(func, fastmath={"nnan", "nsz"})


def is_warm() -> bool:
    """Say whether compiled kernels of this version are in the cache already."""
    folder = cache_root() / "kernels"
    return any(folder.glob("*/**/*.nbi")) if folder.is_dir() else False
