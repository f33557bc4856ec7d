"""What of the examples can be tried without the applications they are for."""

import importlib.util
import re
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

from pxr import Usd, UsdGeom

from dsar_exporters import write_usd

EXAMPLES = Path(__file__).parents[2] / "examples"


def load(name: str, monkeypatch, **modules):
    for module, stand_in in modules.items():
        monkeypatch.setitem(sys.modules, module, stand_in)
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    return loaded


def test_the_houdini_network_chooses_variants_and_takes_the_assets_frames(
    make_sequence, tmp_path, monkeypatch
):
    path = write_usd(make_sequence(), tmp_path / "anna.usda", name="anna")
    hou = MagicMock()
    example = load("houdini_lop", monkeypatch, hou=hou)
    chosen = example.build(str(path), "splats", "quarter")
    hou.setFps.assert_called_once_with(24.0)
    hou.playbar.setFrameRange.assert_called_once_with(1001, 1004)
    (script,) = chosen.parm.return_value.set.call_args_list[-1].args
    stage = Usd.Stage.CreateInMemory()
    stage.GetRootLayer().subLayerPaths.append(str(path))
    lop = SimpleNamespace(pwd=lambda: SimpleNamespace(editableStage=lambda: stage))
    exec(script, {"hou": lop})
    instancer = UsdGeom.PointInstancer.Get(stage, "/anna/instancer")
    assert len(instancer.GetIdsAttr().Get()) == 2
    assert UsdGeom.Imageable(instancer).ComputeVisibility() == UsdGeom.Tokens.invisible
    assert UsdGeom.Imageable(stage.GetPrimAtPath("/anna/splats")).ComputeVisibility() == "inherited"


def test_the_rez_package_requires_what_we_do_and_sets_the_paths():
    paths = {"PYTHONPATH": [], "PATH": []}
    env = SimpleNamespace(**{name: SimpleNamespace(append=found.append) for name, found in paths.items()})
    content: dict = {"env": env}
    exec((EXAMPLES / "package.py").read_text(), content)
    content["commands"]()
    assert paths == {"PYTHONPATH": ["{root}/python"], "PATH": ["{root}/python/bin"]}
    project = tomllib.loads((EXAMPLES.parent / "pyproject.toml").read_text())["project"]
    assert content["version"] == project["version"]
    required = {re.split("[-><=]", each)[0] for each in content["requires"] + content["variants"][0]}
    extras = [each for name in ("exr", "ply") for each in project["optional-dependencies"][name]]
    ours = {re.split("[-><=]", each)[0].lower() for each in project["dependencies"] + extras}
    assert required == ours | {"python", "usd"}
