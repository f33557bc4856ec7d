"""Bake a motion-capture clip (.bvh, CMU skeleton) into the AMASS .npz that the package embeds.

    python tools/bake_motion.py 01_01.bvh --out dsar/data/embedded_motion/cmu_01_01.npz

The clip moves the embedded body (`dsar.data.motions.retargeting`), and the soles stand on y = 0: a tenth of
the frames may reach lower, as toes do that push off. CMU's clips come from mocap.cs.cmu.edu, created with
funding from NSF EIA-0196217, free to use.
"""

import argparse
from pathlib import Path

import torch

from dsar.body.files import load_body
from dsar.body.skinning import pose_vertices
from dsar.data.motions.files import read_motion, resample, write_motion
from dsar.types import Motion


def main() -> None:
    """Read, retarget, resample, put on the ground, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("bvh", type=Path, help="a clip on CMU's skeleton")
    parser.add_argument("--out", type=Path, required=True, help="the .npz to write")
    parser.add_argument("--fps", type=float, default=30.0, help="frames per second to write")
    arguments = parser.parse_args()
    body = load_body()
    motion = resample(read_motion(arguments.bvh, body), arguments.fps)
    lowest = torch.stack([pose_vertices(body, pose)[:, 1].min() for pose in motion])
    ground = torch.quantile(lowest, 0.1)
    motion = Motion(
        motion.rotations,
        motion.translations - ground * torch.tensor([0.0, 1.0, 0.0]),
        motion.fps,
        arguments.out.stem,
    )
    write_motion(arguments.out, motion, body)
    levels = torch.quantile(lowest - ground, torch.tensor([0.0, 0.25, 0.5, 0.75, 1.0])).tolist()
    print(f"{arguments.out}: {len(motion)} frames, {arguments.out.stat().st_size / 1e3:.0f} kB")
    print("quartiles of the lowest vertex's height, m:", *(f"{level:.3f}" for level in levels))


if __name__ == "__main__":
    main()
