"""The build hook where the viewer cannot be built: it goes on, says so loudly, leaves a note."""

import importlib.util
import json
import sys
import types
from pathlib import Path

import pytest

from dougong.report.viewer import why_missing

HOOK = Path(__file__).parent.parent / "hatch_build.py"


@pytest.fixture
def hook(tmp_path, monkeypatch):
    """The hook on a copy of what it needs, its npm out of reach; and what it says."""
    if not HOOK.is_file():
        pytest.skip("the build hook is not part of an installed package")
    shape = types.ModuleType("hatchling.builders.hooks.plugin.interface")
    shape.BuildHookInterface = object
    monkeypatch.setitem(sys.modules, shape.__name__, shape)
    spec = importlib.util.spec_from_file_location("hatch_build_of_test", HOOK)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    for name in ("package.json", "package-lock.json", "build.mjs", "src/report.js"):
        file = tmp_path / "viewer" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("{}")
    static = tmp_path / "src" / "dougong" / "report" / "static"
    static.mkdir(parents=True)
    (static / "report.js").write_text("an old bundle")
    said = []
    made = module.ViewerHook()
    made.root = str(tmp_path)
    made.app = types.SimpleNamespace(display_warning=said.append)

    def out_of_reach(program, *arguments, folder):
        raise module.subprocess.CalledProcessError(
            1, ["python", "-c", "code", "ci"], stderr="npm error code ECONNREFUSED\nnpm error x\n"
        )

    monkeypatch.setattr(module, "_node", out_of_reach)
    return made, static, said


def test_without_the_registry_the_build_goes_on_and_says_so(hook, monkeypatch):
    made, static, said = hook
    monkeypatch.delenv("DOUGONG_REQUIRE_VIEWER", raising=False)
    made.initialize("standard", {})
    assert "could not be built" in said[0]
    assert "still\npictures only" in said[0]
    assert "ECONNREFUSED" in said[0]
    record = json.loads((static / "viewer.json").read_text())
    assert record["is_built"] is False
    assert not (static / "report.js").exists(), "no old bundle stays"
    assert "ECONNREFUSED" in why_missing(static)


def test_it_can_be_made_an_error(hook, monkeypatch):
    made, _, _ = hook
    monkeypatch.setenv("DOUGONG_REQUIRE_VIEWER", "1")
    with pytest.raises(RuntimeError, match="ECONNREFUSED"):
        made.initialize("standard", {})
