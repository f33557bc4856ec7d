from itertools import pairwise

import numpy as np
import pytest
import torch
from pxr import Gf, Usd, UsdGeom, UsdValidation, UsdVol

from dsar.errors import ExportError
from dsar.geometry.cameras import project
from dsar.types import Gaussians
from dsar_exporters import write_usd

FIRST, LAST, FPS = 1001, 1004, 24.0


@pytest.fixture(params=["usda", "usdc"])
def stage(request, make_sequence, cameras, tmp_path) -> Usd.Stage:
    path = tmp_path / f"avatar.{request.param}"
    return Usd.Stage.Open(str(write_usd(make_sequence(degree=1), path, name="avatar", cameras=cameras)))


def _instancer(stage: Usd.Stage) -> UsdGeom.PointInstancer:
    return UsdGeom.PointInstancer.Get(stage, "/avatar/instancer")


def _splats(stage: Usd.Stage) -> UsdVol.ParticleField3DGaussianSplat:
    return UsdVol.ParticleField3DGaussianSplat.Get(stage, "/avatar/splats")


def _wxyz(quaternions) -> np.ndarray:
    return np.array([[q.GetReal(), *q.GetImaginary()] for q in quaternions])


def _visible(prim: Usd.Prim) -> bool:
    return UsdGeom.Imageable(prim).ComputeVisibility() == UsdGeom.Tokens.inherited


def test_the_stage_states_units_axes_time_and_provenance(stage):
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y
    assert stage.GetTimeCodesPerSecond() == stage.GetFramesPerSecond() == FPS
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (FIRST, LAST)
    assert stage.GetDefaultPrim().GetPath() == "/avatar"
    assert stage.GetRootLayer().customLayerData["dsar"] == {"motion": "swing"}


def test_both_representations_hold_the_frames_that_were_produced(stage, make_sequence):
    instancer, splats = _instancer(stage), _splats(stage)
    for frame, gaussians in make_sequence(degree=1):
        scales = 2 * gaussians.scales.numpy()
        for prim in (instancer, splats):
            np.testing.assert_array_equal(prim.GetPositionsAttr().Get(frame), gaussians.means)
        np.testing.assert_array_equal(instancer.GetScalesAttr().Get(frame), scales)
        np.testing.assert_array_equal(splats.GetScalesAttr().Get(frame), gaussians.scales)
        np.testing.assert_array_equal(splats.GetOpacitiesAttr().Get(frame), gaussians.opacities)
        harmonics = splats.GetRadianceSphericalHarmonicsCoefficientsAttr().Get(frame)
        np.testing.assert_array_equal(harmonics, gaussians.harmonics.reshape(-1, 3))
        for attribute, digits in (
            (splats.GetOrientationsAttr(), 1e-7),
            (instancer.GetOrientationsfAttr(), 1e-7),
            (instancer.GetOrientationsAttr(), 1e-3),
        ):
            found = _wxyz(attribute.Get(frame))
            np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=digits)
            np.testing.assert_allclose(np.abs((found * gaussians.rotations.numpy()).sum(1)), 1, atol=digits)
    assert instancer.GetPrim().GetCustomDataByKey("dsar:sigmaScale") == 2
    assert splats.GetRadianceSphericalHarmonicsDegreeAttr().Get() == 1
    assert list(instancer.GetIdsAttr().Get()) == list(range(5))


def test_an_instance_is_the_two_sigma_ellipsoid_of_its_gaussian(stage, make_sequence):
    _, gaussians = next(iter(make_sequence(degree=1)))
    found = _instancer(stage).ComputeInstanceTransformsAtTime(FIRST, FIRST)
    for i, matrix in enumerate(found):
        rows = np.array(matrix)[:3, :3]
        w, x, y, z = gaussians.rotations[i].tolist()
        turn = np.array(Gf.Matrix3d(Gf.Quatd(w, x, y, z)))
        sigma = np.diag(gaussians.scales[i].numpy() ** 2)
        np.testing.assert_allclose(rows.T @ rows, 4 * turn.T @ sigma @ turn, rtol=1e-3, atol=1e-7)


def test_between_frames_particles_are_halfway(stage):
    for attribute in (_instancer(stage).GetPositionsAttr(), _splats(stage).GetPositionsAttr()):
        ends = [np.array(attribute.Get(frame)) for frame in (FIRST, FIRST + 1)]
        np.testing.assert_allclose(attribute.Get(FIRST + 0.5), np.mean(ends, 0), rtol=1e-6)


def test_quaternions_stay_in_one_hemisphere_from_frame_to_frame(stage):
    for attribute in (_instancer(stage).GetOrientationsAttr(), _splats(stage).GetOrientationsAttr()):
        frames = [_wxyz(attribute.Get(frame)) for frame in range(FIRST, LAST + 1)]
        assert all(((a * b).sum(1) > 0).all() for a, b in pairwise(frames))


@pytest.mark.parametrize("step", [1, 2])
def test_velocities_carry_each_sample_to_the_next(make_sequence, tmp_path, step):
    sequence = make_sequence(step=step)
    stage = Usd.Stage.Open(str(write_usd(sequence, tmp_path / "avatar.usdc", name="avatar")))
    positions, velocities = _instancer(stage).GetPositionsAttr(), _instancer(stage).GetVelocitiesAttr()
    primvar = UsdGeom.PrimvarsAPI(_splats(stage)).GetPrimvar("velocities")
    for earlier, later in pairwise(sequence.frame_numbers):
        moved = np.array(positions.Get(earlier)) + np.array(velocities.Get(earlier)) * step / FPS
        np.testing.assert_allclose(moved, positions.Get(later), atol=1e-6)
        np.testing.assert_array_equal(primvar.Get(earlier), velocities.Get(earlier))
    last = sequence.frame_numbers[-1]
    np.testing.assert_array_equal(velocities.Get(last), velocities.Get(last - step))


def test_extents_hold_three_sigma_of_every_gaussian_and_no_more(stage, make_sequence):
    for frame, gaussians in make_sequence(degree=1):
        w, x, y, z = gaussians.rotations.T.tolist()
        corners = []
        for i in range(len(gaussians)):
            turn = np.array(Gf.Matrix3d(Gf.Quatd(w[i], x[i], y[i], z[i])))
            covariance = turn.T @ np.diag(gaussians.scales[i].numpy() ** 2) @ turn
            reach = 3 * np.sqrt(np.diag(covariance))
            corners.append([gaussians.means[i].numpy() - reach, gaussians.means[i].numpy() + reach])
        expected = np.array([np.min(corners, 0)[0], np.max(corners, 0)[1]])
        for prim in (_instancer(stage), _splats(stage)):
            np.testing.assert_allclose(prim.GetExtentAttr().Get(frame), expected, atol=1e-5)


def test_the_unloaded_asset_still_has_its_bounds(make_sequence, tmp_path):
    path = write_usd(make_sequence(), tmp_path / "avatar.usda", name="avatar")
    stage = Usd.Stage.Open(str(path), Usd.Stage.LoadNone)
    assert not stage.GetPrimAtPath("/avatar/splats").IsDefined()
    hint = np.array(UsdGeom.ModelAPI(stage.GetDefaultPrim()).GetExtentsHint(Usd.TimeCode.Default()))
    stage.Load()
    extents = np.array([_splats(stage).GetExtentAttr().Get(frame) for frame in range(FIRST, LAST + 1)])
    np.testing.assert_array_equal(hint, [extents[:, 0].min(0), extents[:, 1].max(0)])


def test_one_representation_is_visible_at_a_time_and_instances_come_first(stage):
    prims = [_instancer(stage).GetPrim(), _splats(stage).GetPrim()]
    assert [_visible(prim) for prim in prims] == [True, False]
    variants = stage.GetDefaultPrim().GetVariantSet("representation")
    assert sorted(variants.GetVariantNames()) == ["instancer", "splats"]
    variants.SetVariantSelection("splats")
    assert [_visible(prim) for prim in prims] == [False, True]


def test_usd_cameras_project_like_ours(stage, cameras):
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(0)).double() + torch.tensor(
        [-0.5, 0.5, -0.5]
    )
    for camera in cameras:
        found = UsdGeom.Camera.Get(stage, f"/avatar/cameras/{camera.name}").GetCamera(FIRST)
        frustum = found.frustum
        matrix = np.array(frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix())
        clip = np.concatenate([points.numpy(), np.ones((50, 1))], 1) @ matrix
        ndc = clip[:, :2] / clip[:, 3:]
        pixels = (ndc * [1, -1] + 1) / 2 * [camera.width, camera.height]
        expected, _ = project(camera, points)
        np.testing.assert_allclose(pixels, expected, atol=1e-2)
        assert found.clippingRange.min == pytest.approx(0.01)
        assert found.focalLength == pytest.approx(0.5)


def test_values_that_never_change_are_written_once(stage):
    instancer, splats = _instancer(stage), _splats(stage)
    color = UsdGeom.PrimvarsAPI(instancer).GetPrimvar("displayColor").GetAttr()
    for attribute in (instancer.GetScalesAttr(), splats.GetOpacitiesAttr(), color):
        assert not attribute.GetNumTimeSamples()
    assert splats.GetPositionsAttr().GetNumTimeSamples() == 4


def test_a_value_that_changes_once_holds_until_then(make_sequence, tmp_path):
    def change(index: int, g: Gaussians) -> Gaussians:
        opacities = torch.full_like(g.opacities, 0.25 if index < 2 else 0.75)
        return Gaussians(g.means, g.rotations, g.scales, opacities, g.harmonics)

    path = write_usd(make_sequence(change=change), tmp_path / "avatar.usdc", name="avatar")
    stage = Usd.Stage.Open(str(path))
    opacities = _splats(stage).GetOpacitiesAttr()
    found = {time: opacities.Get(time)[0] for time in (1001, 1001.5, 1002, 1002.5, 1003, 1004)}
    assert found == {1001: 0.25, 1001.5: 0.25, 1002: 0.25, 1002.5: 0.5, 1003: 0.75, 1004: 0.75}


def test_display_colors_are_linear_and_opacity_follows(make_sequence, tmp_path):
    def change(_: int, g: Gaussians) -> Gaussians:
        return Gaussians(g.means, g.rotations, g.scales, g.opacities, torch.zeros_like(g.harmonics))

    path = write_usd(make_sequence(change=change), tmp_path / "avatar.usdc", name="avatar")
    stage = Usd.Stage.Open(str(path))
    primvars = UsdGeom.PrimvarsAPI(_instancer(stage))
    np.testing.assert_allclose(primvars.GetPrimvar("displayColor").Get(FIRST), 0.21404, atol=1e-5)
    assert primvars.GetPrimvar("displayColor").GetInterpolation() == UsdGeom.Tokens.vertex
    opacities = _splats(stage).GetOpacitiesAttr().Get(FIRST)
    np.testing.assert_array_equal(primvars.GetPrimvar("displayOpacity").Get(FIRST), opacities)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("count", [0, 1, 3])
def test_validators_find_nothing(make_sequence, cameras, tmp_path, count, degree):
    sequence = make_sequence(count, degree, frames=2)
    path = write_usd(sequence, tmp_path / "avatar.usda", name="avatar", cameras=cameras)
    stage = Usd.Stage.Open(str(path))
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert not UsdValidation.ValidationContext(validators).Validate(stage)
    harmonics = _splats(stage).GetRadianceSphericalHarmonicsCoefficientsAttr()
    assert len(harmonics.Get(FIRST)) == count * (degree + 1) ** 2


def test_a_single_frame_is_a_whole_asset(make_sequence, tmp_path):
    path = write_usd(make_sequence(frames=1), tmp_path / "avatar.usdc", name="avatar")
    stage = Usd.Stage.Open(str(path))
    assert not np.any(_instancer(stage).GetVelocitiesAttr().Get(FIRST))
    assert len(_splats(stage).GetPositionsAttr().Get(FIRST)) == 5


def test_the_usda_root_is_small_and_finds_its_payload_wherever_the_folder_goes(
    make_sequence, cameras, tmp_path
):
    path = write_usd(make_sequence(500), tmp_path / "a" / "avatar.usda", name="avatar", cameras=cameras)
    assert path.stat().st_size < 4096
    assert (path.parent / "avatar.payload.usdc").stat().st_size > 50_000
    moved = path.parent.rename(tmp_path / "b") / path.name
    stage = Usd.Stage.Open(str(moved))
    assert len(_splats(stage).GetPositionsAttr().Get(FIRST)) == 500


@pytest.mark.parametrize("suffix", ["usda", "usdc"])
def test_a_failing_frame_leaves_the_earlier_asset_untouched(
    make_sequence, breaking_sequence, tmp_path, suffix
):
    path = write_usd(make_sequence(), tmp_path / f"avatar.{suffix}", name="avatar")
    before = {found.name: found.read_bytes() for found in tmp_path.iterdir()}
    with pytest.raises(RuntimeError, match="the network failed"):
        write_usd(breaking_sequence, path, name="avatar")
    assert {found.name: found.read_bytes() for found in tmp_path.iterdir()} == before


@pytest.mark.parametrize(
    ("path", "name", "message"),
    [
        ("avatar.usdz", "avatar", "ending in .usda, .usdc, .usd"),
        ("avatar.usda", "2nd avatar", "USD name: expected letters"),
    ],
    ids=["suffix", "name"],
)
def test_what_usd_cannot_hold_is_refused_before_any_frame(breaking_sequence, tmp_path, path, name, message):
    with pytest.raises(ExportError, match=message):
        write_usd(breaking_sequence, tmp_path / path, name=name)
    assert not list(tmp_path.iterdir())


def test_two_cameras_of_one_name_are_refused(make_sequence, cameras, tmp_path):
    with pytest.raises(ExportError, match=r"found \['cam00'\] twice"):
        write_usd(make_sequence(), tmp_path / "a.usda", name="a", cameras=[cameras[0]] * 2)
