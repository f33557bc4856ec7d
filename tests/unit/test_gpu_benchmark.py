"""The benchmark for GPUs stays alive: all of it runs, tiny, on the CPU."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def run(script, *arguments):
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(ROOT / script), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, env=environment, check=False)


def test_every_section_runs_on_the_cpu(tmp_path):
    done = run("benchmarks/gpu.py", "--quick", "--json", tmp_path / "gpu.json")
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "gpu.json").read_text())
    assert all(entry["failed"] is None and entry["rows"] for entry in found["sections"].values())
    assert {row["preset"] for row in found["sections"]["training"]["rows"]} == {"demo", "paper"}
    assert all(row.get("agrees", True) for row in found["sections"]["parity"]["rows"])
    last = found["ratios"][-1]
    assert last["what"].startswith("rollout, paper: ours")
    assert done.stdout.splitlines()[-1].startswith(last["what"])


def test_a_section_that_breaks_keeps_its_rows_and_says_why(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    from isolated import SectionError, stream_isolated

    def reason(work, seconds=60.0):
        stream = stream_isolated(work, (), seconds)
        assert next(stream) == {"row": 1}
        with pytest.raises(SectionError) as error:
            next(stream)
        return str(error.value)

    def well():
        yield {"row": 1}
        yield {"row": 2}

    def raises():
        yield {"row": 1}
        raise ValueError("no such kernel")

    def dies():
        yield {"row": 1}
        os._exit(3)

    def hangs():
        yield {"row": 1}
        os.read(os.pipe()[0], 1)

    assert list(stream_isolated(well, (), 60.0)) == [{"row": 1}, {"row": 2}]
    assert reason(raises) == "ValueError: no such kernel"
    assert reason(dies) == "its process ended with code 3"
    assert reason(hangs, 1.0) == "took longer than 1 s"
