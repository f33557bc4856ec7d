"""The kernels with the other number of lanes: blocks, masks and scratch arrays all depend on it."""

import os
import subprocess
import sys
from pathlib import Path

from dsar.raster.simd import LANES

# Misreports what this machine's registers hold; LLVM makes two of one that is too wide.
SCRIPT = """
import sys
import llvmlite.binding

features = llvmlite.binding.get_host_cpu_features()
class Other(type(features)):
    def get(self, name, default=None):
        return {wide} if name == "avx512f" else super().get(name, default)
llvmlite.binding.get_host_cpu_features = lambda: Other(features)
import pytest
chosen = "(equals_reference or equal_the_reference or threads or rebuild) and not warp"
plain = ["-p", "no:cacheprovider", "-o", "filterwarnings=", "-o", "addopts=--import-mode=importlib"]
# Shapes and types are checked where these tests run as usual.
failed = pytest.main([*plain, "--noconftest", "-m", "not gpu", "-q", "-k", chosen, "{tests}"])
from dsar.raster.simd import LANES
sys.exit(failed or LANES != {lanes})
"""


def test_fast_equals_slow_with_the_other_number_of_lanes(tmp_path):
    lanes = 24 - LANES
    script = SCRIPT.format(wide=lanes == 16, lanes=lanes, tests=Path(__file__).with_name("test_agreement.py"))
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
