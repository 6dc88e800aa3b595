"""The import direction of the rooms: who may import whom."""

import ast
from pathlib import Path

import pytest

import dougong

PACKAGE = Path(dougong.__file__).parent
BASE = {"errors", "typing", "params", "_boxes", "_checks", "_words", "threads"}
ALLOWED = {
    "kernels": set(),
    "_sorting": BASE | {"kernels"},
    "cloud": BASE,
    "filters": BASE | {"_sorting", "cloud", "kernels"},
    "formats": BASE | {"_sorting", "cloud", "kernels"},
    "registration": BASE | {"_sorting", "cloud", "kernels", "filters"},
    "tiles": BASE | {"_sorting", "cloud", "kernels", "filters", "formats"},
    "pipeline": BASE
    | {"_sorting", "cloud", "kernels", "filters", "formats", "registration", "tiles"},
    "evaluation": BASE | {"cloud", "kernels", "filters", "formats", "registration", "pipeline"},
    "report": BASE | {"_sorting", "cloud", "formats", "filters", "registration", "pipeline"},
    "app": BASE
    | {
        "cloud",
        "filters",
        "formats",
        "registration",
        "tiles",
        "pipeline",
        "evaluation",
        "report",
    },
    "cli": BASE | {"app"},
    "__main__": {"cli"},
    "__init__": BASE | {"app", "cloud", "filters", "registration", "formats", "evaluation"},
}
MODULES = sorted(PACKAGE.rglob("*.py"))


def room_of(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def rooms_imported(path: Path) -> set[str]:
    rooms = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module == "dougong":
            names = [f"dougong.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import; write the full name"
            names = [node.module or ""]
        else:
            continue
        rooms |= {name.split(".")[1] for name in names if name.startswith("dougong.")}
    return rooms


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_go_one_way(path):
    room = room_of(path)
    allowed = ALLOWED.get(room, BASE) | {room}
    wrong = rooms_imported(path) - allowed
    assert not wrong, f"{path.name} in room {room} imports {sorted(wrong)}"


def test_only_one_file_names_numba_options():
    users = [
        path.name
        for path in MODULES
        if "njit" in path.read_text(encoding="utf-8") and path.name != "_jit.py"
    ]
    assert users == []
