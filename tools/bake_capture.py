"""Bake an embedded capture: choreograph, simulate the skirt, render eight views, pack.

    python tools/bake_capture.py --work DIR [--out DIR] [--only NAME ...] [--stage simulate|render|pack]
    python tools/bake_capture.py --work DIR [--out DIR] [--only NAME ...] --unseen
    python tools/bake_capture.py --work DIR --subject embedded-wool --blender-python PYTHON [...]

The second line simulates the unseen motions, which are not rendered, and adds them to the capture at --out.
The third bakes the second subject, whose cloth Blender simulates; PYTHON is of an environment of its own:

    python3.11 -m venv BPY && BPY/bin/pip install "bpy==4.5.15" "numpy<2"

Needs the `mitsuba` extra and libLLVM >= 19. Every stage keeps its results in DIR and skips what is there.
The same seed gives the same bytes on the same versions.
"""

import argparse
import time
from pathlib import Path

import numpy as np
import torch
from capture.choreography import Take, choreograph
from capture.garment import fit_skirt
from capture.pack import add_unseen, write_capture
from capture.subjects import SEED, SUBJECTS, Subject, draper, select_takes
from capture.unseen import choreograph_unseen
from PIL import Image

from dsar.atomic_files import atomic_write
from dsar.body.files import EMBEDDED_BODY, load_body
from dsar.body.skinning import forward_kinematics
from dsar.types import Body

ROOT = Path(__file__).resolve().parents[1]


def main() -> None:
    """Run the stages asked for."""
    parser = argparse.ArgumentParser(description="Bake an embedded capture.")
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--out", type=Path, help="default: the subject's folder in dsar/data")
    parser.add_argument("--subject", choices=tuple(SUBJECTS), default="embedded")
    parser.add_argument("--blender-python", type=Path, help="a Python with bpy, for embedded-wool")
    parser.add_argument(
        "--unseen", action="store_true", help="add the unseen motions to the capture in --out"
    )
    parser.add_argument("--only", nargs="*", help="sequences to bake; all by default")
    parser.add_argument("--stage", choices=("simulate", "render", "pack"), help="one stage instead of all")
    args = parser.parse_args()
    torch.set_num_threads(1)
    subject = SUBJECTS[args.subject]
    if subject.needs_blender and args.blender_python is None and args.stage in (None, "simulate"):
        parser.error(f"{subject.name} is simulated by Blender: give --blender-python, one that has bpy")
    out = args.out or ROOT / "dsar/data" / subject.folder
    body = load_body()
    clips = ROOT / "dsar/data/embedded_motion"
    takes, pair = select_takes(subject, *choreograph(body, clips, SEED))
    if args.unseen:
        takes = choreograph_unseen(body, clips, SEED)
    takes = {name: take for name, take in takes.items() if not args.only or name in args.only}
    args.work.mkdir(parents=True, exist_ok=True)
    if args.stage in (None, "simulate"):
        simulate_takes(subject, body, takes, args.work, args.blender_python)
    if args.stage in (None, "render") and not args.unseen:
        render_takes(subject, body, takes, args.work)
    if args.stage in (None, "pack") and args.unseen:
        add_unseen(subject, out, args.work, body, takes)
    elif args.stage in (None, "pack"):
        from capture.scene import build_cameras

        pairs = [pair] if pair.sequence in takes else []
        write_capture(subject, out, args.work, body, takes, build_cameras(), pairs)


def simulate_takes(
    subject: Subject, body: Body, takes: dict[str, Take], work: Path, blender_python: Path | None
) -> None:
    """Write WORK/NAME.RUN.npy for every take; all but training ones have a second, slightly disturbed run."""
    skirt = fit_skirt(body, subject.cut)
    drape = draper(subject, blender_python)
    for name, take in takes.items():
        for run in range(1 if take.split == "train" else 2):
            path = work / f"{name}.{run}.npy"
            if path.exists():
                continue
            start = time.monotonic()
            cloth = drape(body, skirt, take.motion, run)
            with atomic_write(path) as draft, draft.open("wb") as file:
                np.save(file, cloth)
            print(f"{name} run {run}: {len(cloth)} frames in {time.monotonic() - start:.0f} s", flush=True)


def render_takes(subject: Subject, body: Body, takes: dict[str, Take], work: Path) -> None:
    """Write WORK/NAME/CAMERA/FRAME.png for every frame of run 0 that is not there yet."""
    from capture.scene import DressedPerson, build_cameras
    from capture.shading import studio_lighting
    from capture.wardrobe import dress

    with np.load(EMBEDDED_BODY) as file:
        layers = dress(body, file["part"], [str(name) for name in file["part_names"]], SEED)
    skirt = fit_skirt(body, subject.cut)
    person = DressedPerson(layers, skirt, subject.paint, studio_lighting(), subject.print_seed)
    cameras = build_cameras()
    for name, take in takes.items():
        cloth = np.load(work / f"{name}.0.npy")
        transforms = forward_kinematics(body, take.motion.rotations, take.motion.translations)
        for camera in cameras:
            (work / name / camera.name).mkdir(parents=True, exist_ok=True)
        start, made = time.monotonic(), 0
        for frame in range(len(take.motion)):
            paths = [work / name / camera.name / f"{frame:04d}.png" for camera in cameras]
            if all(path.exists() for path in paths):
                continue
            person.place(transforms[frame], cloth[frame])
            for camera, path in zip(cameras, paths, strict=True):
                _write_png(path, person.photograph(camera))
            made += 1
            if made % 20 == 0:
                seconds = (time.monotonic() - start) / made
                print(f"{name}: {frame + 1} of {len(take.motion)} frames, {seconds:.2f} s each", flush=True)


def _write_png(path: Path, image: np.ndarray) -> None:
    with atomic_write(path) as draft:
        Image.fromarray(image).save(draft, "PNG", compress_level=1)


if __name__ == "__main__":
    main()
