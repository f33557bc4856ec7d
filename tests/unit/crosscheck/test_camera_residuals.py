"""Cameras: where Mitsuba sees points, and where our projection has them."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from any_camera import random_camera

from dsar.errors import ConfigError
from dsar.geometry.camera_faults import PROJECTION_FAULTS, explain_projection
from dsar.geometry.cameras import project
from dsar_exporters import read_back_projections, write_usd
from dsar_exporters.projections import _single_gaussian as speck
from dsar_exporters.usd import read_usd_projections
from dsar_render.crosscheck.comparison import TOLERANCE_PX, find_fault, seed_mistakes
from dsar_render.crosscheck.points import (
    Residuals,
    SphereObservations,
    _centroids,
    _render,
    camera_projection,
    matrix_projection,
    place_spheres,
    project_spheres,
)
from dsar_render.crosscheck.sensors import square_pixels


@pytest.mark.parametrize("seed", range(20))
def test_valid_cameras_agree_to_a_twentieth_of_a_pixel(scalar, seed):
    camera = random_camera(seed)
    observations = project_spheres(scalar, camera, seed)
    found = Residuals.from_distances(observations.residuals(camera_projection(camera)))
    assert found.rms < 0.03
    assert found.max < 0.08
    assert find_fault(camera, observations, camera_projection(camera)) is None


def test_a_large_camera_agrees_as_well_though_it_is_looked_through_at_1024_pixels(scalar, oblong):
    large = oblong.resized(32 * oblong.width, 24 * oblong.height)
    observations = project_spheres(scalar, large)
    assert Residuals.from_distances(observations.residuals(camera_projection(large))).rms < 0.05
    shifted = PROJECTION_FAULTS[0].changes[0](large)
    assert find_fault(large, observations, camera_projection(large)) is None
    assert find_fault(large, observations, camera_projection(shifted)) == "half_pixel_shift"


def test_files_project_as_mitsuba_sees(scalar, oblong):
    observations = project_spheres(scalar, oblong)
    for kind, projections in read_back_projections([oblong]).items():
        found = Residuals.from_distances(observations.residuals(matrix_projection(projections["oblong"])))
        assert found.rms < 0.03, kind


def test_files_project_as_we_do_in_every_place(oblong):
    random = torch.Generator().manual_seed(0)
    points = torch.randn(50, 3, generator=random, dtype=torch.float64) * 0.5
    ours, _ = project(oblong, points)
    written = read_back_projections([oblong])
    assert set(written) == {"usd", "exr", "exr_lens"}
    for kind, projections in written.items():
        theirs = matrix_projection(projections["oblong"])(points)
        torch.testing.assert_close(theirs, ours, atol=2e-4, rtol=0, msg=kind)


def test_seeded_mistakes_are_caught_and_named(scalar, oblong):
    found = seed_mistakes(scalar, oblong)
    assert len(found) == 7
    assert found == {name: name for name in found}


@pytest.mark.parametrize("mistake", PROJECTION_FAULTS, ids=lambda mistake: mistake.name)
def test_every_way_to_make_a_mistake_has_its_name(mistake):
    for seed in range(5):
        camera = random_camera(seed)
        points, _ = place_spheres(camera, seed)
        for make in mistake.changes:
            places, _ = project(make(camera), points)
            found = explain_projection(camera, points, places, TOLERANCE_PX)
            assert found is not None
            assert found.name == mistake.name


def test_mistakes_in_matrices_made_by_hand_are_named(scalar, oblong):
    """As somebody writes them who has never seen ours."""
    observations = project_spheres(scalar, oblong)
    K, T = oblong.K.double().numpy(), oblong.T_camera_world.double().numpy()
    (fx, _, cx), (_, fy, cy) = K[0], K[1]

    def matrix(K, T):
        return np.vstack([K @ T[:3], [0, 0, 0, 0], T[2]])[[0, 1, 3, 4]]

    def transposed(T):
        return np.block([[T[:3, :3].T, T[:3, 3:]], [np.zeros((1, 3)), 1]])

    wrong = {
        "half_pixel_shift": matrix(np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]]), T),
        "flipped_y": matrix(np.array([[fx, 0, cx], [0, -fy, oblong.height - cy], [0, 0, 1]]), T),
        "transposed_rotation": matrix(K, transposed(T)),
        "principal_point_sign": matrix(
            np.array([[fx, 0, oblong.width - cx], [0, fy, oblong.height - cy], [0, 0, 1]]), T
        ),
        "focal_axis": matrix(np.array([[fy, 0, cx], [0, fx, cy], [0, 0, 1]]), T),
        "camera_to_world": matrix(K, np.linalg.inv(T)),
        "centimetres": matrix(K, np.hstack([T[:, :3], T[:, 3:] * [[100], [100], [100], [1]]])),
    }
    assert find_fault(oblong, observations, matrix_projection(matrix(K, T))) is None
    found = {name: find_fault(oblong, observations, matrix_projection(each)) for name, each in wrong.items()}
    assert found == {name: name for name in wrong}


def test_a_stage_that_says_it_is_in_other_units_is_caught(scalar, oblong, tmp_path):
    pxr = pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom

    assert pxr
    path = write_usd(speck(), tmp_path / "stage.usda", name="stage", cameras=[oblong])
    sizes = {"oblong": (oblong.width, oblong.height)}
    observations = project_spheres(scalar, oblong)
    right = matrix_projection(read_usd_projections(path, sizes)["oblong"])
    assert find_fault(oblong, observations, right) is None
    stage = Usd.Stage.Open(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    stage.Save()
    wrong = matrix_projection(read_usd_projections(path, sizes)["oblong"])
    assert find_fault(oblong, observations, wrong) == "centimetres"


def test_cameras_may_have_any_names(oblong):
    odd = [dataclasses.replace(oblong, name=name) for name in ("turntable", "Kamera ü", "0001")]
    for projections in read_back_projections(odd).values():
        assert set(projections) == {"turntable", "Kamera ü", "0001"}


def test_what_is_no_usual_mistake_is_unknown(scalar, oblong):
    turned = oblong.T_camera_world.clone()
    turned[:3, 3] += torch.tensor([0.02, 0.0, 0.01])
    observations = project_spheres(scalar, oblong)
    wrong = dataclasses.replace(oblong, T_camera_world=turned)
    assert find_fault(oblong, observations, camera_projection(wrong)) == "unknown"


def test_a_mistake_in_what_mitsuba_was_told_is_named_too(scalar, oblong):
    shifted = PROJECTION_FAULTS[0].changes[0](oblong)
    observations = project_spheres(scalar, shifted)
    assert find_fault(oblong, observations, camera_projection(oblong)) == "half_pixel_shift"


def test_points_that_mitsuba_does_not_see_are_infinitely_far(scalar, oblong):
    """Half of the image is seen, so half of the spheres are."""
    centers, radii = place_spheres(oblong)
    narrow = oblong.cropped(0, 0, oblong.width // 2, oblong.height)
    image = _render(scalar, square_pixels(narrow)[0], centers, radii)
    areas = torch.full((len(centers),), math.pi * 9 * 150 / 172, dtype=torch.float64)
    found = SphereObservations(centers, _centroids(image, len(centers), areas))
    distances = found.residuals(camera_projection(square_pixels(narrow)[0]))
    columns, border = project(oblong, centers)[0][:, 0], oblong.width / 2
    assert 5 < int((columns < border - 4).sum()) < 20
    assert distances[columns < border - 4].isfinite().all()
    assert distances[columns > border + 4].isinf().all()
    assert not np.isfinite(Residuals.from_distances(distances).max)


def test_a_camera_in_square_pixels_sees_the_same(oblong):
    square, taller = square_pixels(oblong)
    points, _ = place_spheres(oblong)
    wanted, _ = project(oblong, points)
    found, _ = project(square, points)
    assert square.K[0, 0] == pytest.approx(float(square.K[1, 1]))
    torch.testing.assert_close(found / torch.tensor([1.0, taller]), wanted, atol=1e-4, rtol=0)
    assert 0 <= square.height - oblong.height * taller < 1


def test_skew_is_refused(oblong):
    K = oblong.K.clone()
    K[0, 1] = 0.5
    with pytest.raises(ConfigError, match=r"camera oblong: expected no skew .* found 0\.5"):
        square_pixels(dataclasses.replace(oblong, K=K))
