"""What counts as wrong, and what as not checked."""

import dataclasses
import math

import pytest

from dsar_render.crosscheck.comparison import cross_check
from dsar_render.crosscheck.points import Residuals
from dsar_render.crosscheck.proxies import Agreement, Shape, ellipsoids
from dsar_render.crosscheck.splats import Explanation
from dsar_render.crosscheck.verdict import CameraVerdict, SplatVerdict, Verdict

NAN = math.nan
SEEN, UNSEEN = Agreement(0.999, 1e-5, 1.0), Agreement(NAN, NAN, NAN)


def camera(proxy: Agreement = SEEN, mistakes: dict[str, str] | None = None) -> CameraVerdict:
    return CameraVerdict("cam0", {"ours": Residuals(0.01, 0.02)}, mistakes or {}, proxy)


def splats(coverage=0.001, ours=1e-6, theirs=1e-3, correlation=0.99) -> SplatVerdict:
    explanation = Explanation(ours, (), theirs)
    return SplatVerdict(31.0, coverage, {"cam0": explanation}, {"means": (correlation, 1.0)})


def verdict(*cameras: CameraVerdict, splats: SplatVerdict | None = None, caught: bool = True) -> Verdict:
    seeds = {"flipped_y": "flipped_y" if caught else None}
    return Verdict("scalar_rgb", cameras or (camera(),), seeds, splats, {})


def test_what_agrees_passes():
    found = verdict(camera(), splats=splats())
    assert found.passed
    assert found.faults == []


@pytest.mark.parametrize(
    ("wrong", "word"),
    [
        (verdict(camera(mistakes={"usd": "flipped_y"})), "cam0, usd: flipped_y"),
        (verdict(camera(Agreement(0.98, 1e-5, 1.0))), "IoU 0.980"),
        (verdict(camera(Agreement(0.999, 2e-3, 1.0))), "2.0 mm"),
        (verdict(camera(Agreement(0.999, 1e-5, 0.9))), "10.0%"),
        (verdict(camera(Agreement(0.0, NAN, NAN))), "IoU 0.000"),
        (verdict(camera(UNSEEN)), "no camera sees the body"),
        (verdict(splats=splats(coverage=0.01)), "cover 1.00%"),
        (verdict(splats=splats(coverage=NAN)), "cover nan%"),
        (verdict(splats=splats(ours=0.01)), "0.0100 from their definition"),
        (verdict(splats=splats(theirs=0.02)), "0.0200 that nothing explains"),
        (verdict(splats=splats(theirs=NAN)), "nothing explains"),
        (verdict(splats=splats(correlation=-0.99)), "means correlate by -0.99"),
        (verdict(splats=splats(correlation=NAN)), "means correlate"),
    ],
)
def test_what_does_not_agree_fails_and_is_named(wrong, word):
    assert not wrong.passed
    (fault,) = wrong.faults
    assert word in fault


def test_a_seed_that_is_missed_fails_without_a_fault():
    missed = verdict(caught=False)
    assert missed.faults == []
    assert not missed.passed


def test_figures_leave_out_cameras_that_see_nothing():
    figures = verdict(camera(), dataclasses.replace(camera(UNSEEN), name="cam1")).figures.to_json()
    assert figures["passed"]
    assert figures["silhouette_iou"] == 0.999
    assert figures["cameras"]["cam1"]["proxy"]["iou"] is None


def test_a_camera_that_looks_away_is_reported_as_such(scalar, oblong, cloud):
    turned = oblong.T_camera_world.clone()
    turned[[0, 2]] *= -1
    away = dataclasses.replace(oblong, T_camera_world=turned, name="away")
    found = cross_check(scalar, [oblong, away], {}, [ellipsoids(cloud)], None)
    assert found.passed
    assert found.skipped["away, proxies"] == "sees nothing of the body"
    assert set(found.pictures) == {"proxies, oblong"}
    assert not cross_check(scalar, [away], {}, [ellipsoids(cloud)], None).passed


def test_splats_that_no_camera_sees_are_reported_as_not_checked(llvm, oblong, cloud):
    behind = dataclasses.replace(cloud, means=cloud.means + 10.0 * oblong.T_camera_world[2, :3] * -1)
    ball: Shape = ellipsoids(cloud)
    found = cross_check(llvm, [oblong], {}, [ball], behind)
    assert found.splats is None
    assert found.skipped["splat_psnr"] == "no camera sees a Gaussian"


def test_cameras_of_other_sizes_are_checked_together(scalar, oblong, cloud):
    other = dataclasses.replace(oblong.resized(96, 130), name="upright")
    found = cross_check(scalar, [oblong, other], {}, [ellipsoids(cloud)], None)
    assert found.passed
    assert [each.name for each in found.cameras] == ["oblong", "upright"]
