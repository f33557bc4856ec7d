"""Import an avatar's USD into Blender as it was exported: rate, range, and colours if there is a PLY.

    blender --python examples/blender_import.py -- avatar.usda [ply/avatar.1001.ply]

Needs nothing but Blender (4.2 or later); also runs under the `bpy` module.
"""

import json
import sys
from pathlib import Path

import bpy
import numpy as np

C0 = 0.28209479177387814


def import_avatar(path: str, ply: str | None = None) -> None:
    """Import a USD asset of `dsar export` into the open scene.

    Gaussians become a point cloud with an ellipsoid each, the body an armature, cameras cameras. The scene
    takes the file's frames and frame rate, and a view without a tone curve: colours of splats have a
    display's curve already.

    Args:
        path: The asset; its manifest lies beside it.
        ply: One frame's splat file of the same export. Blender's importer leaves out the colours of
            instances, and they are taken from here.
    """
    rate = json.loads(Path(f"{path}.manifest.json").read_text())["frames"]["fps"]
    known = set(bpy.data.objects)
    bpy.ops.wm.usd_import(filepath=path, set_frame_range=True)
    scene = bpy.context.scene
    # The importer leaves the scene's rate as it was.
    scene.render.fps, scene.render.fps_base = round(rate), round(rate) / rate
    scene.view_settings.view_transform = "Standard"
    if ply is not None:
        made = set(bpy.data.objects) - known
        color_instances(made, import_colors(ply))


def import_colors(ply: str) -> bpy.types.Object:
    """Return a hidden mesh whose points carry the colours of a splat file, linear, in its order."""
    bpy.ops.wm.ply_import(filepath=ply)
    holder = bpy.context.object
    mesh, count = holder.data, len(holder.data.vertices)
    srgb = np.zeros((count, 3), np.float32)
    for channel in range(3):
        values = np.zeros(count, np.float32)
        mesh.attributes[f"f_dc_{channel}"].data.foreach_get("value", values)
        srgb[:, channel] = np.clip(values * C0 + 0.5, 0, None)
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    colors = np.concatenate([linear, np.ones((count, 1))], 1).astype(np.float32)
    mesh.attributes.new("displayColor", "FLOAT_COLOR", "POINT").data.foreach_set("color", colors.ravel())
    holder.hide_render = True
    holder.hide_set(True)
    return holder


def color_instances(objects: set[bpy.types.Object], holder: bpy.types.Object) -> None:
    """Give the instances of an imported asset the colours that another object's points carry."""
    (cloud,) = [each for each in objects if each.type == "POINTCLOUD"]
    (modifier,) = [each for each in cloud.modifiers if each.type == "NODES"]
    nodes, links = modifier.node_group.nodes, modifier.node_group.links
    (instance,) = [node for node in nodes if node.bl_idname == "GeometryNodeInstanceOnPoints"]
    source = nodes.new("GeometryNodeObjectInfo")
    source.inputs["Object"].default_value = holder
    name = nodes.new("GeometryNodeInputNamedAttribute")
    name.data_type, name.inputs["Name"].default_value = "FLOAT_COLOR", "displayColor"
    chosen = nodes.new("GeometryNodeSampleIndex")
    chosen.data_type, chosen.domain = "FLOAT_COLOR", "POINT"
    stored = nodes.new("GeometryNodeStoreNamedAttribute")
    stored.data_type, stored.domain = "FLOAT_COLOR", "POINT"
    stored.inputs["Name"].default_value = "displayColor"
    points = instance.inputs["Points"].links[0].from_socket
    links.new(source.outputs["Geometry"], chosen.inputs["Geometry"])
    links.new(name.outputs["Attribute"], chosen.inputs["Value"])
    links.new(nodes.new("GeometryNodeInputIndex").outputs["Index"], chosen.inputs["Index"])
    links.new(points, stored.inputs["Geometry"])
    links.new(chosen.outputs["Value"], stored.inputs["Value"])
    links.new(stored.outputs["Geometry"], instance.inputs["Points"])
    material = color_material()
    for each in objects:
        if each.type == "MESH" and each.name.startswith("ellipsoid"):
            each.data.materials.clear()
            each.data.materials.append(material)


def color_material() -> bpy.types.Material:
    """Return a material that emits each instance's own colour: light is in the splats already."""
    material = bpy.data.materials.new("splat colors")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    color = nodes.new("ShaderNodeAttribute")
    color.attribute_type, color.attribute_name = "INSTANCER", "displayColor"
    light = nodes.new("ShaderNodeEmission")
    output = nodes.new("ShaderNodeOutputMaterial")
    links.new(color.outputs["Color"], light.inputs["Color"])
    links.new(light.outputs["Emission"], output.inputs["Surface"])
    return material


if __name__ == "__main__":
    import_avatar(*sys.argv[sys.argv.index("--") + 1 :])
