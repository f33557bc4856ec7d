"""A stage as other applications make it."""

from pathlib import Path

import pytest
from pxr import Usd, UsdGeom
from usd_stages import Stages


@pytest.fixture
def make_stage(tmp_path: Path) -> Stages:
    """Make a stage as others do: centimetres, Z up, 24 a second."""

    def make(
        name: str = "stage.usda", up: str = "Z", unit: float | None = 0.01, rate: float = 24.0
    ) -> Usd.Stage:
        stage = Usd.Stage.CreateNew(str(tmp_path / name))
        UsdGeom.SetStageUpAxis(stage, up)
        if unit is not None:
            UsdGeom.SetStageMetersPerUnit(stage, unit)
        stage.SetTimeCodesPerSecond(rate)
        return stage

    return make
