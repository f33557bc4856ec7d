"""The GPU benchmark records our network's step as a graph, which a CPU cannot show."""

import dataclasses
from pathlib import Path

from tests.devices.recorded_graphs import cuda_graphs

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


def test_a_recorded_step_gives_the_same_offsets(device, monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    from gpu_network import CASES, OURS, Variant, measure_variant, settings

    config, case, exact = settings("demo", True), dataclasses.replace(CASES[0], batch=2), {}
    with cuda_graphs():
        for start in ("eager", "graph"):
            variant = Variant(OURS, "float32", start)
            row = measure_variant(config, case, variant, "rollout", device, 0.01, exact)
            assert row["largest_difference_mm"] == 0
    assert exact[OURS].abs().max() > 0
