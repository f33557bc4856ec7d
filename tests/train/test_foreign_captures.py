"""Foreign captures train as the capture does that they were written from; foreign motions drive."""

import dataclasses
import json
import logging
import math
import re
import shutil
from functools import partial

import layouts
import numpy as np
import pytest
import torch
from PIL import Image

from dsar.body.files import EMBEDDED_BODY, load_body
from dsar.cli import main
from dsar.data.captures.formats import open_capture
from dsar.data.motions.files import write_motion
from dsar.types import Motion
from tests.conftest import train_arguments

STEPS = ("--steps", "20", "--workers", "1")


def native_part(tiny, folder, parts, fps=30.0, change=lambda image: image):
    """Write a capture of our own of some frames of the tiny one: new name to old name, frames and split."""
    capture, record = open_capture(tiny), json.loads((tiny / "capture.json").read_text())
    folder.mkdir()
    sequences = {}
    for new, (old, frames, split) in parts.items():
        motion = dataclasses.replace(capture.motions[old].slice(frames.start, frames.stop), fps=fps)
        write_motion(folder / f"{new}.npz", motion, capture.body)
        for index, camera in enumerate(capture.cameras):
            (folder / new / camera.name).mkdir(parents=True)
            for number, frame in enumerate(frames):
                image = change(capture.image(old, frame, index))
                Image.fromarray(image).save(folder / new / camera.name / f"{number:04d}.png")
        sequences[new] = {"motion": f"{new}.npz", "images": new, "frames": len(frames), "split": split}
    (folder / "capture.json").write_text(json.dumps(record | {"fps": fps, "sequences": sequences}))
    return folder


def losses(capture, out, *more):
    """Train; return the losses of every five updates, and leave no pictures."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("dsar.training.loop.REPORT_EVERY", 5)
        patch.setattr("dsar.cli.train.write_previews", lambda folder, _: folder)
        main(train_arguments(capture, out, *STEPS, *map(str, more)))
    lines = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [5, 10, 15, 20]
    return np.array([line["loss"] for line in lines])


def compressed(image, *, mask):
    """What JPEG leaves of an image, and of its mask."""
    color, alpha = layouts.through_jpg(layouts.on_wall(image)), image[..., 3]
    return np.dstack([color, layouts.through_jpg(alpha) if mask else alpha])


@pytest.mark.parametrize(
    ("writers", "fps", "mask"),
    [
        ((layouts.write_avatarrex, layouts.write_thuman4), 30.0, True),
        ((layouts.write_actorshq,), 25.0, False),
    ],
    ids=["avatarrex and thuman4", "actorshq"],
)
def test_a_capture_of_one_take_has_the_loss_curve_of_the_original(tiny_capture, tmp_path, writers, fps, mask):
    """The original is cut as the readers cut a single take, and its images went through JPEG."""
    parts = {"turn_train": ("turn", range(8), "train"), "turn_test": ("turn", range(9, 14), "test")}
    original = native_part(tiny_capture, tmp_path / "native", parts, fps, partial(compressed, mask=mask))
    expected = losses(original, tmp_path / "run")
    for write in writers:
        root = tmp_path / write.__name__ / "turn"
        write(open_capture(tiny_capture), "turn", root, layouts.z_up())
        flags = ("--body", EMBEDDED_BODY, "--train-frames", "0-7", "--test-frames", "9-13")
        found = losses(root, tmp_path / write.__name__ / "run", *flags)
        np.testing.assert_allclose(found, expected, rtol=0.003)


def test_takes_of_4d_dress_have_the_loss_curve_of_the_original(tiny_capture, tmp_path):
    parts = {
        "Take1": ("turn", range(14), "train"),
        "Take2": ("sway", range(12), "train"),
        "Take3": ("bend", range(10), "test"),
    }
    expected = losses(native_part(tiny_capture, tmp_path / "native", parts), tmp_path / "a")
    hands = layouts.body_with_hands(tmp_path / "body.npz")
    capture = open_capture(tiny_capture)
    layouts.write_dress(capture, ["turn", "sway", "bend"], tmp_path / "dress", layouts.z_up(), hands=hands)
    found = losses(tmp_path / "dress", tmp_path / "b", "--body", tmp_path / "body.npz")
    np.testing.assert_allclose(found, expected, rtol=0.003)


def test_avatarrex_trains_with_no_flag_but_the_folder(tiny_capture, tmp_path, monkeypatch):
    """Long enough to be cut, with a body from the environment that the run remembers."""
    monkeypatch.setenv("DSAR_BODY", str(EMBEDDED_BODY))
    capture = open_capture(tiny_capture)
    layouts.write_avatarrex(lengthened(capture, 10), "long", tmp_path / "take")
    run = tmp_path / "run"
    main(train_arguments(tmp_path / "take", run, "--steps", "20", "--workers", "1"))
    monkeypatch.delenv("DSAR_BODY")
    assert json.loads((run / "config.json").read_text())["body"] == str(EMBEDDED_BODY)
    main(["eval", str(run), "--json", str(tmp_path / "eval.json"), "--progress", "none"])
    test = json.loads((tmp_path / "eval.json").read_text())["splits"]["test"]
    assert (test["frames"], test["views"]) == (3, 4)
    main(train_arguments(tmp_path / "take", run, "--steps", "24", "--workers", "1", "--resume"))


def test_a_capture_with_gaps_trains_and_is_measured(tiny_capture, tmp_path):
    """Frames that no camera saw, the stillest among them, and some that some cameras did not see."""
    root = shutil.copytree(tiny_capture, tmp_path / "gaps")
    images = root / "images"
    for camera in range(4):
        for frame in (0, 1, 5):
            (images / f"turn/cam{camera}/{frame:04d}.png").unlink()
    for sequence, camera, frame in (("sway", 2, 0), ("sway", 0, 3), ("bend", 1, 4), ("bend", 1, 7)):
        (images / f"{sequence}/cam{camera}/{frame:04d}.png").unlink()
    run = tmp_path / "run"
    main(train_arguments(root, run, "--steps", "30", "--workers", "1"))
    main(["eval", str(run), "--json", str(tmp_path / "eval.json"), "--progress", "none"])
    figures = json.loads((tmp_path / "eval.json").read_text())
    # Every second of ten frames; cam1 lacks one of them, and is no whole film.
    assert (figures["splits"]["test"]["frames"], figures["splits"]["test"]["views"]) == (5, 4)
    assert figures["splits"]["test"]["psnr"] > 10


def lengthened(capture, times):
    """The sequence `turn` there and back again and again, as the sequence `long`."""

    class Repeated:
        def has(self, camera, frame):
            return True

        def read(self, camera, frame):
            return capture.views["turn"].read(camera, order[frame])

    count = len(capture.motions["turn"])
    order = [*range(count), *range(count - 1, -1, -1)] * (times // 2)
    turn = capture.motions["turn"]
    motion = Motion(turn.rotations[order], turn.translations[order], turn.fps, "long")
    return dataclasses.replace(capture, motions={"long": motion}, views={"long": Repeated()}, starts={})


def test_frames_that_train_are_chosen_from_our_own_captures_too(tiny_capture):
    capture = open_capture(tiny_capture, train_frames="2-6", test_frames="3-5")
    whole = open_capture(tiny_capture)
    assert {name: len(motion) for name, motion in capture.motions.items()} == {
        "sway": 5,
        "turn": 5,
        "bend": 3,
    }
    assert np.array_equal(capture.image("sway", 0, 1), whole.image("sway", 2, 1))
    assert torch.equal(capture.motions["bend"].rotations, whole.motions["bend"].rotations[3:6])


def swing(fps):
    """A smooth motion of one and a half seconds."""
    t = torch.arange(round(1.5 * fps) + 1) / fps
    rotations, translations = torch.zeros(len(t), 55, 3), torch.zeros(len(t), 3)
    rotations[:, 0, 1] = 1.2 * torch.sin(2 * math.pi * 0.5 * t)
    rotations[:, 16, 2], rotations[:, 17, 2] = -1.0 + 0.4 * torch.sin(5 * t), 1.0
    rotations[:, 3, 0] = 0.2 * torch.sin(4 * t)
    translations[:, 0] = 0.2 * torch.sin(3 * t)
    return Motion(rotations, translations, float(fps), "swing")


def test_amass_files_at_any_rate_drive_the_avatar_to_the_same_motion(trained, tmp_path):
    from plyfile import PlyData

    placed = {}
    for fps in (30, 60, 100, 120):
        write_motion(tmp_path / f"{fps}.npz", swing(fps), load_body())
        with np.load(tmp_path / f"{fps}.npz") as file:
            arrays = {key: file[key] for key in file.files}
        # AMASS's SMPL+H: 52 joints, and the older name of the rate.
        arrays["poses"] = np.delete(arrays["poses"], np.s_[66:75], axis=1)
        arrays["mocap_framerate"] = arrays.pop("mocap_frame_rate")
        np.savez(tmp_path / f"{fps}.npz", **arrays)
        out = tmp_path / str(fps)
        main(
            [
                "export",
                str(trained),
                "--motion",
                str(tmp_path / f"{fps}.npz"),
                "--ply",
                str(out),
                "--progress",
                "none",
            ]
        )
        files = sorted(out.glob("*.ply"))
        assert len(files) == 46
        tables = [PlyData.read(str(path))["vertex"] for path in files]
        placed[fps] = np.stack([np.stack([table[axis] for axis in "xyz"], -1) for table in tables])
    travel = np.sqrt(((placed[30] - placed[30][:1]) ** 2).sum(-1).mean())
    assert travel > 0.1
    for fps in (60, 100, 120):
        rms = np.sqrt(((placed[fps] - placed[30]) ** 2).sum(-1).mean(1))
        assert rms.max() < 0.002, fps


def test_motion_faster_than_training_is_reported_with_frame_numbers(trained, tmp_path, caplog):
    caplog.set_level(logging.INFO)
    slow = swing(30)
    write_motion(
        tmp_path / "fast.npz", dataclasses.replace(slow, fps=30.0, rotations=slow.rotations * 8), load_body()
    )
    main(
        [
            "export",
            str(trained),
            "--motion",
            str(tmp_path / "fast.npz"),
            "--ply",
            str(tmp_path / "p"),
            "--progress",
            "none",
        ]
    )
    assert "frames are faster than any training" in caplog.text
    assert "Motion fast: its poses' MMD from training is" in caplog.text
    # The guards' lines, which follow, name frames of their own.
    line = caplog.text.split("m/s): ")[1].splitlines()[0]
    listed = [int(number) for number in re.findall(r"\b1\d{3}\b", line)]
    assert listed == sorted(set(listed))
    assert 1002 <= listed[0] <= listed[-1] <= 1046
