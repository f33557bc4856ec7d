import subprocess
import sys

import pytest

HEAVY = ("pxr", "mitsuba", "drjit", "OpenEXR", "OpenImageIO", "gsplat", "warp", "fourdgs", "gsply", "plyfile")


@pytest.mark.parametrize("package", ["dsar", "dsar_exporters", "dsar_render"])
def test_importing_a_package_loads_no_optional_library(package):
    script = f"import sys, {package}; print(*(name for name in {HEAVY} if name in sys.modules))"
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == ""


def test_importing_dsar_prints_and_warns_nothing():
    result = subprocess.run(
        [sys.executable, "-W", "error", "-c", "import dsar"], capture_output=True, text=True, check=True
    )
    assert (result.stdout, result.stderr) == ("", "")
