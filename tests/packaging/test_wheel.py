import importlib.metadata
import subprocess
import sys
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest

from dsar.config import EMBEDDED_CAPTURES

REPOSITORY = Path(__file__).parents[2]
SOURCES = {
    "dsar": REPOSITORY / "dsar",
    "dsar_exporters": REPOSITORY / "exporters" / "dsar_exporters",
    "dsar_render": REPOSITORY / "render" / "dsar_render",
}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel as users get it, built without a network by the backend that pyproject names."""
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(command, cwd=REPOSITORY, check=True, capture_output=True)
    with zipfile.ZipFile(next(folder.glob("*.whl"))) as archive:
        yield archive


def list_files(package):
    """Every file below a package's source folder but caches, as the wheel should name it."""
    root = SOURCES[package]
    files = (path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file())
    return {f"{package}/{file}" for file in files if "__pycache__" not in file and not file.endswith(".tmp")}


def read_metadata(wheel):
    """The wheel's METADATA as an email message."""
    name = next(name for name in wheel.namelist() if name.endswith(".dist-info/METADATA"))
    return Parser().parsestr(wheel.read(name).decode())


def test_wheel_installs_exactly_our_three_packages(wheel):
    top = {name.split("/")[0] for name in wheel.namelist()}
    assert {name for name in top if not name.endswith(".dist-info")} == set(SOURCES)


@pytest.mark.parametrize("package", SOURCES)
def test_wheel_holds_every_file_of_the_package(wheel, package):
    packed = {name for name in wheel.namelist() if name.startswith(f"{package}/")}
    assert packed == list_files(package)
    assert f"{package}/py.typed" in packed


@pytest.mark.parametrize("package", SOURCES)
def test_every_folder_with_modules_is_a_package(package):
    folders = {path.parent for path in SOURCES[package].rglob("*.py")}
    assert not [str(folder) for folder in folders if not (folder / "__init__.py").exists()]


def test_wheel_carries_what_the_embedded_demo_reads(wheel):
    names = wheel.namelist()
    assert "dsar/body/data/body.npz" in names
    for folder in EMBEDDED_CAPTURES.values():
        assert f"dsar/data/{folder}/capture.json" in names
        assert any(name.startswith(f"dsar/data/{folder}/images/") for name in names)


def test_wheel_carries_licence_and_notice(wheel):
    files = {name.rsplit("/", 1)[1]: name for name in wheel.namelist() if "/licenses/" in name}
    assert "Apache License" in wheel.read(files["LICENSE"]).decode()
    assert "mocap.cs.cmu.edu" in wheel.read(files["NOTICE"]).decode()


def test_plain_install_needs_no_delivery_library(wheel):
    required = [line for line in read_metadata(wheel).get_all("Requires-Dist", []) if "extra ==" not in line]
    assert not [line for line in required if line.lower().startswith(("usd-core", "openexr", "mitsuba"))]


def test_changelog_names_the_version(wheel):
    version = read_metadata(wheel)["Version"]
    assert f"## [{version}]" in (REPOSITORY / "CHANGELOG.md").read_text()


def test_installed_version_is_the_one_built(wheel):
    assert importlib.metadata.version("dsar-avatar") == read_metadata(wheel)["Version"]
