"""Runs in Blender's Python: imports an asset's cameras and exports them again, as a user would.

blender_cameras_probe.py ASSET FOLDER WIDTH HEIGHT

Writes FOLDER/default.usda, and converted.usda in centimetres, Y up, with one prim a camera. Apertures are
made for the scene's resolution.
"""

import sys
from pathlib import Path

import bpy


def main() -> None:
    asset, folder, width, height = sys.argv[1:]
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.usd_import(filepath=asset, set_frame_range=True)
    scene = bpy.context.scene
    scene.render.resolution_x, scene.render.resolution_y = int(width), int(height)
    for thing in list(bpy.data.objects):
        if thing.type not in ("CAMERA", "EMPTY"):
            bpy.data.objects.remove(thing)
    bpy.data.objects["front"].name = "front door.001"
    exported = {
        "default": {},
        "converted": {
            "convert_orientation": True,
            "convert_scene_units": "CENTIMETERS",
            "merge_parent_xform": True,
        },
    }
    for name, options in exported.items():
        path = str(Path(folder) / f"{name}.usda")
        bpy.ops.wm.usd_export(filepath=path, export_animation=True, **options)


main()
