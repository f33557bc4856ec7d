"""Programs of others that our files are tried in; `make interop` installs them into .interop/."""

import shutil
from pathlib import Path

import pytest

HERE = Path(__file__).parents[2] / ".interop"


def _or_skip(stamp: str, what: str) -> Path:
    # The stamp is made when the installation has ended.
    if not (HERE / stamp).exists():
        pytest.skip(f"{what} is not installed: make interop")
    return HERE


@pytest.fixture(scope="session")
def blender() -> Path:
    """A Python that has Blender as its module `bpy`."""
    return _or_skip(".blender", "Blender (bpy)") / "blender" / "bin" / "python"


@pytest.fixture(scope="session")
def node() -> str:
    found = shutil.which("node")
    if found is None:
        pytest.skip("Node.js is not installed")
    return found


@pytest.fixture(scope="session")
def splat_transform(node) -> list[str]:
    """The command of PlayCanvas's converter."""
    modules = _or_skip(".node", "splat-transform") / "node_modules"
    return [node, str(modules / "@playcanvas" / "splat-transform" / "bin" / "cli.mjs")]


@pytest.fixture(scope="session")
def node_modules(node) -> Path:
    """Where three.js, the splat viewer Spark and Playwright lie."""
    return _or_skip(".node", "the splat viewer Spark") / "node_modules"


@pytest.fixture(scope="session")
def chromium() -> str:
    names = ("chromium", "chromium-browser", "google-chrome")
    found = next((path for name in names if (path := shutil.which(name))), None)
    if found is None:
        pytest.skip("Chromium is not installed")
    return found
