"""Build a Solaris network that shows an avatar's USD: run with hython, or in Houdini's Python shell.

    hython examples/houdini_lop.py avatar.usda splats out.hip

Written from Houdini's documentation and not tried in Houdini; its USD part is tested with usd-core.
"""

import json
import sys
from pathlib import Path

import hou

CHOOSE = """
stage = hou.pwd().editableStage()
for prim in stage.GetPseudoRoot().GetChildren():
    for name, choice in {choices!r}.items():
        if prim.GetVariantSets().HasVariantSet(name):
            prim.GetVariantSet(name).SetVariantSelection(choice)
"""


def build(path: str, representation: str = "splats", lod: str = "full") -> "hou.LopNode":
    """Return the last node of a network that loads an asset and chooses what stands for the Gaussians.

    The scene takes the asset's frames and frame rate from the manifest beside it.

    Args:
        path: The `.usda` of `dsar export`.
        representation: `splats`, `instancer` or `proxy`.
        lod: `full`, `half` or `quarter`.
    """
    frames = json.loads(Path(f"{path}.manifest.json").read_text())["frames"]
    hou.setFps(frames["fps"])
    hou.playbar.setFrameRange(frames["first"], frames["last"])
    stage = hou.node("/stage")
    layer = stage.createNode("sublayer", "avatar")
    layer.parm("filepath1").set(path)
    chosen = stage.createNode("pythonscript", "choose")
    chosen.setInput(0, layer)
    choices = {"representation": representation, "lod": lod}
    chosen.parm("python").set(CHOOSE.format(choices=choices))
    chosen.setDisplayFlag(True)
    return chosen


if __name__ == "__main__":
    build(*sys.argv[1:3])
    hou.hipFile.save(sys.argv[3])
