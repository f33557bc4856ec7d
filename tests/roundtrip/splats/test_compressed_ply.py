"""PlayCanvas's compressed PLY: unpacked as gsply does it, faults of its chunks told."""

from collections.abc import Callable

import gsply
import numpy as np
import pytest
import torch
from splat_files import elements_of, retyped, save, store

from dsar.errors import ExportError
from dsar_exporters import find_faults, read_splats


def test_a_compressed_ply_is_unpacked_as_gsply_does_it(written):
    theirs, ours = gsply.plyread(written["compressed.ply"]), read_splats(written["compressed.ply"])
    assert elements_of(written["compressed.ply"]).keys() == {"chunk", "vertex", "sh"}
    for found, expected in (
        (ours.means, theirs.means),
        (ours.scales, np.exp(theirs.scales)),
        (ours.rotations, theirs.quats / np.linalg.norm(theirs.quats, axis=1, keepdims=True)),
        (ours.opacities, 1 / (1 + np.exp(-theirs.opacities))),
        (ours.harmonics[:, 0], theirs.sh0),
        (ours.harmonics[:, 1:], theirs.shN),
    ):
        torch.testing.assert_close(found, torch.from_numpy(np.array(expected)), rtol=2e-6, atol=2e-6)


def test_a_compressed_ply_is_told_by_its_chunks_in_either_layout_and_under_any_name(written, tmp_path):
    new = elements_of(written["compressed.ply"])
    chunks = new["chunk"]
    # Colours of the older layout have no bounds but 0 and 1.
    for side, bound in (("min", 0), ("max", 1)):
        for channel in "rgb":
            chunks[f"{side}_{channel}"] = bound
    renamed = store(tmp_path / "renamed.PLY", new)
    names = [name for name in chunks.dtype.names if name[-1] not in "rgb"]
    assert len(names) == 12
    shorter = np.ascontiguousarray(retyped(chunks[names], lambda name: "<f4"))
    old = store(tmp_path / "old.ply", {**new, "chunk": shorter})
    assert find_faults(renamed) == find_faults(old) == []
    for name, values in vars(read_splats(renamed)).items():
        assert torch.equal(getattr(read_splats(old), name), values), name


def test_a_plain_ply_under_a_compressed_ones_name_is_read(cloud, tmp_path):
    assert find_faults(save(tmp_path / "a.compressed.ply", cloud)) == []


def _bound(name: str, value: float) -> Callable[[dict[str, np.ndarray]], None]:
    def spoil(elements: dict[str, np.ndarray]) -> None:
        elements["chunk"][name][2] = value

    return spoil


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_bound("max_scale_x", np.inf), "finite min_scale_x and max_scale_x, found 1 of 3 chunks without"),
        (_bound("min_z", np.nan), "expected finite min_z and max_z, found 1 of 3"),
        (_bound("min_y", 99), "expected min_y below max_y, found 1 of 3 chunks the other way round"),
        (_bound("max_r", -99), "expected min_r below max_r"),
        (_bound("max_scale_z", 12), "expected Gaussians smaller than their cloud"),
    ],
)
def test_faulty_bounds_of_chunks_are_told(written, spoil, message):
    elements = elements_of(written["compressed.ply"])
    spoil(elements)
    (fault,) = find_faults(store(written["compressed.ply"], elements))
    assert message in fault


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda e: {**e, "chunk": e["chunk"][:2]}, "for each 256 of its 600 Gaussians, 3 chunks, found 2"),
        (lambda e: {"chunk": e["chunk"]}, "found no properties packed_position, .* in its element 'vertex'"),
        (
            lambda e: {"vertex": e["vertex"]},
            "a compressed PLY without its element 'chunk', so no properties x",
        ),
        (lambda e: {**e, "sh": e["sh"][:9]}, "harmonics of each of 600 Gaussians .* found 9 of 9"),
    ],
)
def test_elements_that_do_not_fit_are_refused(written, change, message):
    path = store(written["compressed.ply"], change(elements_of(written["compressed.ply"])))
    with pytest.raises(ExportError, match=message):
        find_faults(path)
