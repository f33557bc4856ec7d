"""Runs in Blender's Python: imports an asset with our example and writes what Blender made of it.

blender_probe.py EXAMPLE ASSET PLY FOLDER CAMERA WIDTH HEIGHT FRAME...
"""

import importlib.util
import json
import sys
from pathlib import Path

import bpy


def load(path: str):
    spec = importlib.util.spec_from_file_location("example", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def instances(scene) -> list:
    graph = bpy.context.evaluated_depsgraph_get()
    found = [each.matrix_world.translation[:] for each in graph.object_instances if each.is_instance]
    return [list(place) for place in found]


def main() -> None:
    example, asset, ply, folder, camera, width, height, *frames = sys.argv[1:]
    bpy.ops.wm.read_factory_settings(use_empty=True)
    load(example).import_avatar(asset, ply)
    scene = bpy.context.scene
    facts = {
        "types": sorted({thing.type for thing in bpy.data.objects}),
        "cameras": sorted(thing.name for thing in bpy.data.objects if thing.type == "CAMERA"),
        "range": [scene.frame_start, scene.frame_end],
        "rate": scene.render.fps / scene.render.fps_base,
        "instances": {},
        "bones": {},
        "turntable": {},
    }
    (armature,) = [thing for thing in bpy.data.objects if thing.type == "ARMATURE"]
    scene.camera = bpy.data.objects[camera]
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising = 8, False
    scene.render.film_transparent = True
    scene.render.resolution_x, scene.render.resolution_y = int(width), int(height)
    scene.render.image_settings.color_mode = "RGBA"
    for frame in map(int, frames):
        scene.frame_set(frame)
        facts["instances"][frame] = instances(scene)
        facts["bones"][frame] = {
            bone.name: list((armature.matrix_world @ bone.matrix).translation) for bone in armature.pose.bones
        }
        facts["turntable"][frame] = list(bpy.data.objects["turntable"].matrix_world.translation)
        scene.render.filepath = str(Path(folder) / f"{frame}.png")
        bpy.ops.render.render(write_still=True)
    (Path(folder) / "facts.json").write_text(json.dumps(facts))


main()
