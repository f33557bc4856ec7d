import sys
from collections.abc import Callable
from pathlib import Path

import pxr
import pytest
from pxr import Usd, UsdGeom, UsdVol

from dsar.errors import ExportError
from dsar.types import GaussianSequence
from dsar_exporters import write_usd
from dsar_exporters.usd_validation import validate_asset


@pytest.fixture
def sequence(make_sequence: Callable[..., GaussianSequence]) -> GaussianSequence:
    return make_sequence()


@pytest.fixture
def asset(sequence: GaussianSequence, tmp_path: Path) -> Path:
    return write_usd(sequence, tmp_path / "avatar.usdc", name="avatar")


def _drop_units(stage: Usd.Stage) -> None:
    stage.ClearMetadata("metersPerUnit")


def _shorten_positions(stage: Usd.Stage) -> None:
    positions = UsdGeom.PointInstancer.Get(stage, "/avatar/instancer").GetPositionsAttr()
    positions.Set(positions.Get(1004)[:3], 1004)


def _lose_harmonics(stage: Usd.Stage) -> None:
    splats = UsdVol.ParticleField3DGaussianSplat.Get(stage, "/avatar/splats")
    splats.GetRadianceSphericalHarmonicsCoefficientsAttr().Clear()


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_drop_units, "metersPerUnit"),
        (_shorten_positions, r"instancer\.positions at 1004: expected 5 values, found 3"),
        (_lose_harmonics, r"Coefficients at 1001: expected 5 values, found None"),
    ],
)
def test_a_spoiled_asset_is_caught(asset, sequence, spoil, message):
    stage = Usd.Stage.Open(str(asset))
    spoil(stage)
    stage.Save()
    with pytest.raises(ExportError, match=message):
        validate_asset(asset, sequence, name="avatar")


def test_a_usd_core_without_validators_is_reported(asset, sequence, monkeypatch, caplog):
    monkeypatch.setitem(sys.modules, "pxr.UsdValidation", None)
    monkeypatch.delattr(pxr, "UsdValidation", raising=False)
    validate_asset(asset, sequence, name="avatar")
    assert "avatar.usdc: not validated" in caplog.text
