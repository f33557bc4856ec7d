"""Simulate a skirt with Blender's cloth solver: run by a Python that has `bpy`, and by nothing else of ours.

    PYTHON blender_cloth.py JOB.npz RESULT.npz

JOB holds, in metres and with Y up: `start` [n, 3] (the cloth as cut, its first p vertices sewn to the waist),
`quads` [q, 4], `anchors` [f, p, 3], `body` [f, v, 3], `body_faces` [t, 3], `fps`, `gravity` [f, 3], and
`settings`, the JSON of `wool.Wool`. RESULT gets `cloth` [f, n, 3]. Blender has Z up.
"""

import json
import struct
import sys
import tempfile
from pathlib import Path

import bpy
import numpy as np


def main() -> None:
    """Read the job, simulate every frame in order, write the result."""
    job, result = (Path(path) for path in sys.argv[1:3])
    with np.load(job) as file:
        data = dict(file)
    settings = json.loads(str(data["settings"]))
    with tempfile.TemporaryDirectory() as folder:
        cloth = simulate(data, settings, Path(folder))
        np.savez(result, cloth=cloth.astype(np.float32))


def simulate(data: dict[str, np.ndarray], settings: dict[str, float], folder: Path) -> np.ndarray:
    """Return the cloth's vertices [f, n, 3] at every frame; the first is the start."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    frames, pinned = data["anchors"].shape[:2]
    scene.frame_start, scene.frame_end = 1, frames
    scene.render.fps = round(float(data["fps"]))
    body = _add_mesh("body", data["body"][0], data["body_faces"])
    _play_back(body, data["body"], folder / "body.pc2")
    corners = np.array([[-9.0, 0.0, 9.0], [9.0, 0.0, 9.0], [9.0, 0.0, -9.0], [-9.0, 0.0, -9.0]])
    floor = _add_mesh("floor", corners, np.array([[0, 1, 2, 3]]))
    for thing in (body, floor):
        _collide(thing, settings)
    targets = np.repeat(data["start"][None], frames, 0)
    targets[:, :pinned] = data["anchors"]
    skirt = _add_mesh("skirt", data["start"], data["quads"])
    skirt.vertex_groups.new(name="sewn").add(list(range(pinned)), 1.0, "REPLACE")
    _play_back(skirt, targets, folder / "skirt.pc2")
    _make_cloth(skirt, settings, frames)
    pulls = _z_up(data["gravity"])
    cloth = []
    for frame in range(frames):
        scene.gravity = pulls[frame].tolist()
        cloth.append(_evaluate(scene, skirt, frame + 1))
    return np.stack(cloth)


def _add_mesh(name: str, vertices: np.ndarray, faces: np.ndarray) -> bpy.types.Object:
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(_z_up(vertices).tolist(), [], faces.tolist())
    thing = bpy.data.objects.new(name, mesh)
    bpy.context.collection.objects.link(thing)
    return thing


def _play_back(thing: bpy.types.Object, positions: np.ndarray, path: Path) -> None:
    """Let a modifier set the vertices of every frame from a PC2 file."""
    header = struct.pack("<12siiffi", b"POINTCACHE2\0", 1, positions.shape[1], 1.0, 1.0, len(positions))
    path.write_bytes(header + _z_up(positions).astype("<f4").tobytes())
    modifier = thing.modifiers.new("played", "MESH_CACHE")
    modifier.cache_format, modifier.filepath, modifier.frame_start = "PC2", str(path), 1.0
    modifier.interpolation = "LINEAR"


def _collide(thing: bpy.types.Object, settings: dict[str, float]) -> None:
    thing.modifiers.new("collision", "COLLISION")
    thing.collision.thickness_outer = settings["thickness"]
    thing.collision.cloth_friction = settings["friction"]
    thing.collision.use_culling = True


def _make_cloth(skirt: bpy.types.Object, settings: dict[str, float], frames: int) -> None:
    modifier = skirt.modifiers.new("cloth", "CLOTH")
    modifier.point_cache.frame_start, modifier.point_cache.frame_end = 1, frames
    cloth, contact = modifier.settings, modifier.collision_settings
    cloth.vertex_group_mass, cloth.pin_stiffness = "sewn", 1.0
    cloth.quality, cloth.mass = int(settings["quality"]), settings["mass"]
    cloth.air_damping = settings["air"]
    cloth.tension_stiffness = cloth.compression_stiffness = settings["stretch"]
    cloth.tension_damping = cloth.compression_damping = settings["stretch_damping"]
    cloth.shear_stiffness, cloth.shear_damping = settings["shear"], settings["shear_damping"]
    cloth.bending_model = "ANGULAR"
    cloth.bending_stiffness, cloth.bending_damping = settings["bend"], settings["bend_damping"]
    contact.use_collision, contact.use_self_collision = True, False
    contact.collision_quality, contact.distance_min = int(settings["contacts"]), settings["thickness"]
    contact.friction = settings["friction"]


def _evaluate(scene: bpy.types.Scene, skirt: bpy.types.Object, frame: int) -> np.ndarray:
    scene.frame_set(frame)
    mesh = skirt.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    flat = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", flat)
    x, y, z = flat.reshape(-1, 3).T
    return np.stack([x, z, -y], -1)


def _z_up(points: np.ndarray) -> np.ndarray:
    x, y, z = np.moveaxis(points, -1, 0)
    return np.stack([x, -z, y], -1)


if __name__ == "__main__":
    main()
