"""Runs in Blender's Python: takes a part's matte out of an EXR with Blender's own Cryptomatte node.

blender_cryptomatte_probe.py EXR OUT PART WIDTH HEIGHT
"""

import sys

import bpy


def main() -> None:
    source, out, part, width, height = sys.argv[1:]
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    image = bpy.data.images.load(source)
    scene.render.resolution_x, scene.render.resolution_y = int(width), int(height)
    scene.render.resolution_percentage = 100
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(camera)
    scene.camera = camera
    scene.render.engine = "BLENDER_WORKBENCH"
    scene.use_nodes = True
    nodes, links = scene.node_tree.nodes, scene.node_tree.links
    nodes.clear()
    matte = nodes.new("CompositorNodeCryptomatteV2")
    matte.source = "IMAGE"
    matte.image = image
    matte.layer_name = "CryptoMaterial"
    matte.matte_id = part
    composite = nodes.new("CompositorNodeComposite")
    links.new(matte.outputs["Matte"], composite.inputs["Image"])
    settings = scene.render.image_settings
    settings.file_format, settings.color_mode, settings.color_depth = "OPEN_EXR", "RGB", "32"
    scene.render.filepath = out
    bpy.ops.render.render(write_still=True)


main()
