"""What an asset holds beside the frames themselves: pictures rebuilt from it, levels, skeleton, clips."""

import dataclasses
import itertools
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from pxr import Gf, Usd, UsdGeom, UsdSkel, UsdVol, Vt

from dsar.errors import ExportError
from dsar.geometry.camera_paths import turntable
from dsar.geometry.cameras import project
from dsar.geometry.harmonics import C0
from dsar.geometry.rotations import matrix_from_axis_angle
from dsar.raster import rasterize
from dsar.types import Camera, Gaussians
from dsar_exporters import find_faults, write_usd

KINDS = {
    "usda": {"suffix": ".usda"},
    "usdc": {"suffix": ".usdc"},
    "half": {"suffix": ".usda", "half": True},
    "clips": {"suffix": ".usda", "clips": True},
    "half clips in one file": {"suffix": ".usdc", "half": True, "clips": True},
}


@pytest.fixture(scope="module", params=KINDS.values(), ids=KINDS)
def asset(request, figure, front, tmp_path_factory) -> Path:
    options = dict(request.param)
    path = tmp_path_factory.mktemp("asset") / f"anna{options.pop('suffix')}"
    return write_usd(figure, path, name="anna", cameras=[front], **options)


@pytest.fixture
def stage(asset) -> Usd.Stage:
    return Usd.Stage.Open(str(asset))


def psnr(one: torch.Tensor, two: torch.Tensor) -> float:
    return float(-10 * torch.log10((one - two).square().mean()))


def splats_at(stage: Usd.Stage, time: float) -> Gaussians:
    """Rebuild Gaussians from the schema's attributes, as a reader of the specification would."""
    prim = UsdVol.ParticleField3DGaussianSplat.Get(stage, "/anna/splats")

    def values(name: str) -> np.ndarray:
        full = getattr(prim, f"Get{name}Attr")().Get(time)
        found = getattr(prim, f"Get{name}hAttr")().Get(time) if full is None else full
        return np.array(found, np.float32)

    count = (prim.GetRadianceSphericalHarmonicsDegreeAttr().Get() + 1) ** 2
    xyzw = values("Orientations")
    return Gaussians(
        torch.from_numpy(values("Positions")),
        torch.nn.functional.normalize(torch.from_numpy(xyzw[:, [3, 0, 1, 2]]), dim=-1),
        torch.from_numpy(values("Scales")),
        torch.from_numpy(values("Opacities")),
        torch.from_numpy(values("RadianceSphericalHarmonicsCoefficients").reshape(-1, count, 3)),
    )


def instances_at(stage: Usd.Stage, time: float) -> Gaussians:
    """Rebuild Gaussians from instances: ellipsoids of two standard deviations, linear colours."""
    prim = UsdGeom.PointInstancer.Get(stage, "/anna/instancer")
    rotations = np.array(prim.GetOrientationsAttr().Get(time), np.float32)[:, [3, 0, 1, 2]]
    primvars = UsdGeom.PrimvarsAPI(prim)
    linear = np.array(primvars.GetPrimvar("displayColor").Get(time))
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0) ** (1 / 2.4) - 0.055)
    return Gaussians(
        torch.from_numpy(np.array(prim.GetPositionsAttr().Get(time))),
        torch.nn.functional.normalize(torch.from_numpy(rotations), dim=-1),
        torch.from_numpy(np.array(prim.GetScalesAttr().Get(time)) / np.float32(2)),
        torch.from_numpy(np.array(primvars.GetPrimvar("displayOpacity").Get(time))),
        torch.from_numpy(((srgb - 0.5) / C0).astype(np.float32))[:, None],
    )


def test_the_asset_is_sound(asset):
    assert find_faults(asset) == []


def test_pictures_of_the_asset_are_those_of_the_rollout(stage, figure, front):
    for frame, gaussians in figure:
        truth = rasterize(gaussians, front).color
        assert truth.std() > 0.1, "the figure is in the picture"
        assert psnr(rasterize(splats_at(stage, frame), front).color, truth) > 45
        assert psnr(rasterize(instances_at(stage, frame), front).color, truth) > 45


def test_between_frames_the_asset_is_interpolated(stage, figure, front):
    frames = [gaussians for _, gaussians in figure]
    before, after = frames[2], frames[3]
    signs = torch.where((before.rotations * after.rotations).sum(-1, keepdim=True) < 0, -1.0, 1.0)
    halfway = Gaussians(
        *((getattr(before, f) + getattr(after, f)) / 2 for f in ("means",)),
        torch.nn.functional.normalize(before.rotations + signs * after.rotations, dim=-1),
        *((getattr(before, f) + getattr(after, f)) / 2 for f in ("scales", "opacities", "harmonics")),
    )
    truth = rasterize(halfway, front).color
    assert psnr(rasterize(before, front).color, truth) < 40, "the frames differ"
    assert psnr(rasterize(splats_at(stage, 1003.5), front).color, truth) > 45
    # USD carries instances between frames along their velocities.
    reached = UsdGeom.PointInstancer.Get(stage, "/anna/instancer").ComputeInstanceTransformsAtTime(
        1003.5, 1003.5
    )
    assert np.allclose([matrix.ExtractTranslation() for matrix in reached], halfway.means, atol=1e-4)


def test_levels_of_detail_are_nested_and_keep_their_ids(stage, figure, front):
    gaussians = dict(figure)[1004]
    truth = rasterize(gaussians, front).color
    lod = stage.GetDefaultPrim().GetVariantSet("lod")
    assert lod.GetVariantSelection() == "full"
    assert set(lod.GetVariantNames()) == {"full", "half", "quarter"}
    chosen = {}
    for name in ("full", "half", "quarter"):
        lod.SetVariantSelection(name)
        instancer = UsdGeom.PointInstancer.Get(stage, "/anna/instancer")
        ids = np.array(instancer.GetIdsAttr().Get())
        primvar = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/anna/splats")).GetPrimvar("id")
        assert np.array_equal(primvar.Get(), ids)
        assert np.allclose(instancer.GetPositionsAttr().Get(1004), gaussians.means[torch.from_numpy(ids)])
        coarse = rasterize(splats_at(stage, 1004), front)
        assert psnr(coarse.color, truth) > {"full": 45, "half": 24, "quarter": 20}[name]
        chosen[name] = set(ids)
    count = len(gaussians)
    assert [len(chosen[name]) for name in ("full", "half", "quarter")] == [
        count,
        (count + 1) // 2,
        (count + 3) // 4,
    ]
    assert chosen["quarter"] < chosen["half"] < chosen["full"]


def test_one_representation_is_shown_at_a_time(stage):
    variants = stage.GetDefaultPrim().GetVariantSet("representation")
    assert set(variants.GetVariantNames()) == {"instancer", "splats", "proxy"}
    paths = {"instancer": "instancer", "splats": "splats", "proxy": "body/mesh"}
    for name in variants.GetVariantNames():
        variants.SetVariantSelection(name)
        for other, path in paths.items():
            prim = UsdGeom.Imageable(stage.GetPrimAtPath(f"/anna/{path}"))
            assert (prim.ComputeVisibility() == UsdGeom.Tokens.inherited) == (other == name)


def test_the_skeleton_carries_the_mesh_as_our_skinning_does(stage, figure):
    binding = figure.binding
    root = UsdSkel.Root.Get(stage, "/anna/body")
    cache = UsdSkel.Cache()
    cache.Populate(root, Usd.PrimDefaultPredicate)
    (bound,) = cache.ComputeSkelBindings(root, Usd.PrimDefaultPredicate)
    (target,) = bound.GetSkinningTargets()
    skeleton = cache.GetSkelQuery(bound.GetSkeleton())
    assert skeleton.GetJointOrder()[4] == "pelvis/left_hip/left_knee"
    for index, frame in enumerate(figure.frame_numbers):
        transforms = skeleton.ComputeSkinningTransforms(frame)
        points = Vt.Vec3fArray(UsdGeom.Mesh(target.GetPrim()).GetPointsAttr().Get())
        assert target.ComputeSkinnedPoints(transforms, points, frame)
        weights = binding.body.weights @ binding.T_world_rest[index, :, :3].flatten(1)
        blended = weights.unflatten(1, (3, 4))
        expected = (blended[..., :3] @ binding.body.vertices[..., None]).squeeze(-1) + blended[..., 3]
        assert np.abs(np.array(points) - expected.numpy()).max() < 1e-4
        low, high = np.array(root.GetExtentAttr().Get(frame))
        smallest, largest = expected.amin(0).numpy(), expected.amax(0).numpy()
        assert (smallest - 0.5 < low).all()
        assert (low <= smallest + 1e-5).all()
        assert (largest - 1e-5 <= high).all()
        assert (high < largest + 0.5).all()


def test_joints_turn_the_short_way_from_frame_to_frame(figure, tmp_path):
    angle = torch.linspace(0, 3 * math.pi, 6)
    turns = matrix_from_axis_angle(torch.stack([0 * angle, angle, 0 * angle], -1))
    transforms = figure.binding.T_world_rest.clone()
    transforms[:, :, :3, :3] = turns[:, None]
    spinning = dataclasses.replace(
        figure, binding=dataclasses.replace(figure.binding, T_world_rest=transforms)
    )
    path = write_usd(spinning, tmp_path / "a.usda", name="anna")
    stage = Usd.Stage.Open(str(path))
    motion = UsdSkel.Animation.Get(stage, "/anna/body/skeleton/motion")
    frames = [np.array(motion.GetRotationsAttr().Get(frame)) for frame in figure.frame_numbers]
    assert min(frame[0, 3] for frame in frames) < -0.5, "the pelvis turns by more than a full circle"
    assert all((one * two).sum(-1).min() > 0 for one, two in itertools.pairwise(frames))


def test_gaussians_can_be_bound_anew_with_what_they_carry(stage, figure):
    binding = figure.binding
    skeleton = UsdSkel.Skeleton.Get(stage, "/anna/body/skeleton")
    query = UsdSkel.Cache()
    query.Populate(UsdSkel.Root.Get(stage, "/anna/body"), Usd.PrimDefaultPredicate)
    transforms = np.array(query.GetSkelQuery(skeleton).ComputeSkinningTransforms(1005))
    for path in ("/anna/instancer", "/anna/splats"):
        primvars = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(path))
        rest = np.array(primvars.GetPrimvar("restPosition").Get())
        indices, weights = (primvars.GetPrimvar(f"joint{kind}") for kind in ("Indices", "Weights"))
        assert indices.GetElementSize() == weights.GetElementSize() == 4
        joints = np.array(indices.Get()).reshape(-1, 4)
        shares = np.array(weights.Get()).reshape(-1, 4)
        assert np.allclose(shares.sum(1), 1)
        carried = np.einsum(
            "ni,nk,nikc->nc", shares, np.pad(rest, ((0, 0), (0, 1)), constant_values=1), transforms[joints]
        )
        blended = (binding.weights @ binding.T_world_rest[4, :, :3].flatten(1)).unflatten(1, (3, 4)).numpy()
        ours = np.einsum("nij,nj->ni", blended[..., :3], binding.points.numpy()) + blended[..., 3]
        assert np.abs(carried[:, :3] - ours).max() < 0.01
        st = np.array(primvars.GetPrimvar("st").Get())
        assert st.shape == (len(rest), 2)
        assert 0 <= st.min() <= st.max() <= 1


def test_the_texture_of_gaussians_is_that_of_the_mesh(figure):
    body, uv = figure.binding.body, figure.binding.uv
    corners = body.uv[body.uv_faces.long()]
    for index in range(0, len(uv), 97):
        a, b, c = corners.unbind(1)
        edges = torch.stack([b - a, c - a], -1).double()
        # Triangles without area hold no texel.
        sound = torch.linalg.det(edges).abs() > 1e-12
        shares = torch.linalg.solve(edges[sound], (uv[index] - a[sound]).double())
        inside = (shares >= -1e-6).all(1) & (shares.sum(1) <= 1 + 1e-6)
        places = body.vertices[body.faces.long()][sound][inside]
        share = shares[inside].float()
        found = places[:, 0] + ((places[:, 1:] - places[:, :1]) * share[..., None]).sum(1)
        assert (found - figure.binding.points[index]).norm(dim=1).min() < 1e-4


def camera_pixels(
    stage: Usd.Stage, path: str, frame: int, size: Gf.Vec2i, points: torch.Tensor
) -> np.ndarray:
    frustum = UsdGeom.Camera.Get(stage, path).GetCamera(frame).frustum
    matrix = np.array(frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix())
    clip = np.concatenate([points.numpy(), np.ones((len(points), 1))], 1) @ matrix
    return (clip[:, :2] / clip[:, 3:] * [1, -1] + 1) / 2 * [size[0], size[1]]


def test_every_camera_projects_to_a_hundredth_of_a_pixel(stage, figure, front):
    circling = turntable(figure.binding, figure.frame_numbers, figure.fps, width=192, height=256)
    for camera, (frame, gaussians) in zip(circling.cameras, figure, strict=True):
        for path, ours in (("front", front), ("turntable", camera)):
            prim = stage.GetPrimAtPath(f"/anna/cameras/{path}")
            size = prim.GetCustomDataByKey("dsar:resolution")
            found = camera_pixels(stage, str(prim.GetPath()), frame, size, gaussians.means.double())
            expected, _ = project(ours, gaussians.means.double())
            assert np.abs(found - expected.numpy()).max() < 0.01
            assert (found > 0).all()
            assert (found < [ours.width, ours.height]).all()


def test_the_turntable_starts_in_front_and_turns_once_in_eight_seconds(figure):
    binding = dataclasses.replace(figure.binding, T_world_rest=figure.binding.T_world_rest[[0, 0, 0, 0]])

    def place(frame: int) -> torch.Tensor:
        frames = range(frame, frame + 4)
        camera = turntable(binding, frames, 24.0, width=64, height=64).at(frame)
        return camera.center - binding.T_world_rest[0, 0, :3, 3]

    assert place(1001)[2] > 3
    assert abs(place(1001)[0]) < 0.1
    assert place(1001 + 48)[0] > 3
    assert torch.allclose(place(1001 + 192), place(1001), atol=1e-4)


def test_clips_are_a_file_a_frame_and_read_like_one_payload(figure, front, tmp_path):
    whole = write_usd(figure, tmp_path / "whole.usda", name="anna", cameras=[front])
    clipped = write_usd(figure, tmp_path / "clipped.usda", name="anna", cameras=[front], clips=True)
    clips = sorted(path.name for path in (tmp_path / "clipped.clips").glob("*.usdc"))
    assert clips == [f"clipped.{frame}.usdc" for frame in range(1001, 1007)]
    payload = tmp_path / "clipped.payload.usdc"
    assert payload.stat().st_size < 0.5 * (tmp_path / "whole.payload.usdc").stat().st_size
    one, two = (Usd.Stage.Open(str(path)) for path in (whole, clipped))
    compared = 0
    for prim in one.TraverseAll():
        for attribute in prim.GetAttributes():
            other = two.GetAttributeAtPath(attribute.GetPath())
            for time in (1001, 1002.5, 1006):
                values = attribute.Get(time), other.Get(time)
                assert np.array_equal(*(np.array(value) for value in values)), (attribute.GetPath(), time)
                compared += values[0] is not None
    assert compared > 100


def test_clips_hold_a_value_until_it_changes(make_sequence, tmp_path):
    def change(index: int, g: Gaussians) -> Gaussians:
        opacities = torch.full_like(g.opacities, 0.25 if index < 2 else 0.75)
        return Gaussians(g.means, g.rotations, g.scales, opacities, g.harmonics)

    path = write_usd(make_sequence(change=change, step=3), tmp_path / "a.usda", name="anna", clips=True)
    stage = Usd.Stage.Open(str(path))
    prim = UsdVol.ParticleField3DGaussianSplat.Get(stage, "/anna/splats")
    opacities = prim.GetOpacitiesAttr()
    times = (1001, 1002, 1004, 1007, 1010)
    assert [opacities.Get(time)[0] for time in times] == [0.25, 0.25, 0.25, 0.75, 0.75]
    # What never changes is in no clip.
    clip = Usd.Stage.Open(str(tmp_path / "a.clips" / "a.1004.usdc"))
    assert clip.GetAttributeAtPath("/full/splats.positions").IsValid()
    assert not clip.GetAttributeAtPath("/full/splats.scales").IsValid()


def test_half_precision_saves_what_it_promises(figure, tmp_path):
    sizes = {}
    for half in (False, True):
        write_usd(figure, tmp_path / "a.usda", name="anna", half=half)
        sizes[half] = (tmp_path / "a.payload.usdc").stat().st_size
    assert sizes[True] < 0.85 * sizes[False]


def test_a_camera_may_not_take_the_turntables_name(figure, front, tmp_path):
    camera: Camera = dataclasses.replace(front, name="turntable")
    with pytest.raises(ExportError, match="turntable is the name of a camera that we add"):
        write_usd(figure, tmp_path / "a.usda", name="anna", cameras=[camera])
