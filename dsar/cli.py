"""The `dsar` command: parse, build, call. Work and file formats live in the rooms that own them."""

import dataclasses
import itertools
import json
import logging
import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from dsar.config import PRESETS, AtlasConfig, LossConfig, ModelConfig, ScheduleConfig, TrainConfig
from dsar.console import Bar, ProgressStyle, follow
from dsar.errors import ConfigError, DsarError
from dsar.types import Camera, GaussianSequence, RenderOutput

Device = Literal["auto", "cpu", "cuda"]


@dataclass(frozen=True)
class Common:
    """Flags of every command."""

    device: Device = "auto"
    """Where to compute."""
    seed: int = 0
    """Seed of everything random."""
    progress: ProgressStyle = "auto"
    """How to show progress."""
    json: Path | None = None
    """Write what the command found here, machine-readable."""

    def check_device(self) -> None:
        """Raise ConfigError where the device is not supported."""
        if self.device == "cuda":
            raise ConfigError("--device cuda: this version computes on the CPU only; leave --device out")

    def write_json(self, content: dict) -> None:
        """Write the --json file, if one was asked for."""
        if self.json is not None:
            draft = self.json.with_name(self.json.name + ".tmp")
            draft.parent.mkdir(parents=True, exist_ok=True)
            draft.write_text(json.dumps(content, indent=2) + "\n")
            os.replace(draft, self.json)


@dataclass(frozen=True)
class Train(Common):
    """Learn an avatar from a capture."""

    capture: tyro.conf.Positional[str] = "embedded"
    """A capture folder in any supported format, or `embedded`."""
    preset: Literal["demo", "small", "paper"] = "demo"
    """Settings to start from; every other flag overrides them."""
    out: Path | None = None
    """Run folder; default runs/<preset>."""
    body: Path | None = None
    """SMPL-X model file (.npz, .pkl); default: the capture's own, else the embedded body."""
    train_frames: str | None = None
    """Frames of each training sequence, e.g. 0-239."""
    test_frames: str | None = None
    """Frames of each test sequence, e.g. 250-359."""
    cameras: int | None = None
    """Cameras to learn from, spread as far as can be; default: all."""
    steps: int | None = None
    """Updates in all."""
    minutes: float | None = None
    """Wall-clock budget; the schedule is compressed to fit."""
    workers: int | None = None
    """Processes, one core each."""
    resume: bool = False
    """Go on with the run in --out."""
    atlas: AtlasConfig = field(default_factory=AtlasConfig)
    """The texel grid."""
    model: ModelConfig = field(default_factory=ModelConfig)
    """The network."""
    loss: LossConfig = field(default_factory=LossConfig)
    """Weights of the losses."""
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)
    """Stages and optimiser."""

    def config(self) -> TrainConfig:
        """Return the settings of the run."""
        preset = PRESETS[self.preset]
        schedule = dataclasses.replace(
            self.schedule,
            steps=self.schedule.steps if self.steps is None else self.steps,
            minutes=self.schedule.minutes if self.minutes is None else self.minutes,
        )
        return dataclasses.replace(
            preset,
            capture=self.capture,
            body=None if self.body is None else str(self.body),
            train_frames=self.train_frames,
            test_frames=self.test_frames,
            cameras=self.cameras,
            seed=self.seed,
            workers=preset.workers if self.workers is None else self.workers,
            atlas=self.atlas,
            model=self.model,
            loss=self.loss,
            schedule=schedule,
        )

    def run(self) -> None:
        """Train, then leave a contact sheet."""
        from dsar.training.checkpoint import Run, read_progress
        from dsar.training.loop import train
        from dsar.training.report import Report

        self.check_device()
        run = Run(self.out or Path("runs") / self.preset)
        last: list[Report] = []
        with Bar(self.progress, "train").running() as bar:

            def report(line: Report) -> None:
                last[:] = [line]
                left = line.seconds * (1 / max(line.progress, 1e-3) - 1)
                numbers = f"loss {line.loss:.4f} PSNR {line.psnr:.2f} dB"
                bar.show(line.progress, f"{line.stage} step {line.step} {numbers} {left:.0f} s left")

            train(self.config(), run, resume=self.resume, report=report)
        sheet = write_contact_sheet(run.folder)
        reached = dataclasses.asdict(last[-1]) if last else read_progress(run)
        self.write_json({"run": str(run.folder), "sheet": str(sheet), **reached})


@dataclass(frozen=True)
class Drive(Common):
    """Flags of commands that drive a trained avatar."""

    run_folder: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(name="run")] = None
    """Run folder; default: the newest under runs/."""
    motion: str = "test"
    """An AMASS/SMPL-X .npz file, a sequence of the run's capture, or its split `test` or `train`."""
    frames: str | None = None
    """Frame numbers from 1001 on, e.g. 1001-1100x2; default: all."""

    def open(self) -> tuple[GaussianSequence, list[Camera], str]:
        """Return the rollout, the capture's cameras and the motion's name."""
        from dsar.avatar import roll_out
        from dsar.data.capture import open_capture
        from dsar.data.motion import read_motion, resample
        from dsar.training.checkpoint import Run, load_checkpoint, newest_run
        from dsar_exporters import parse_frames

        self.check_device()
        run = Run(self.run_folder) if self.run_folder else newest_run()
        frames = None if self.frames is None else parse_frames(self.frames)
        avatar, config, provenance = load_checkpoint(run)
        capture = open_capture(config.capture)
        name = capture_sequence(capture, self.motion)
        if name is not None:
            motion = capture.motions[name]
        else:
            motion = read_motion(Path(self.motion), avatar.body)
        if motion.fps != avatar.fps:
            motion = resample(motion, avatar.fps)
        sequence = roll_out(avatar, motion, frames=frames, provenance=provenance)
        return sequence, list(capture.cameras), motion.name


@dataclass(frozen=True)
class Export(Drive):
    """Drive an avatar with a motion and write the Gaussians of each frame."""

    usd: Path | None = None
    """USD asset: .usda or .usdc."""
    ply: Path | None = None
    """Folder of 3DGS splat files, one per frame."""
    name: str = "avatar"
    """Name of the asset and of the files."""

    def run(self) -> None:
        """Write every requested format."""
        from dsar_exporters import write_ply, write_usd

        if self.usd is None and self.ply is None:
            raise ConfigError("dsar export: nothing to write; give --usd out.usda, --ply DIR or both")
        sequence, cameras, motion = self.open()
        written: dict[str, str] = {}
        if self.usd is not None:
            write_usd(shown(sequence, self.progress, "usd"), self.usd, name=self.name, cameras=cameras)
            written["usd"] = str(self.usd)
        if self.ply is not None:
            write_ply(shown(sequence, self.progress, "ply"), self.ply, name=self.name)
            written["ply"] = str(self.ply)
        facts = {"gaussians": sequence.num_gaussians, "frames": len(sequence), "fps": sequence.fps}
        self.write_json({"motion": motion, "written": written, **facts})


@dataclass(frozen=True)
class Render(Drive):
    """Drive an avatar with a motion and render image sequences."""

    exr: Path | None = None
    """Folder of EXR sequences: DIR/<camera>/<name>.<camera>.%04d.exr."""
    png: Path | None = None
    """Folder of PNG sequences with alpha."""
    mp4: Path | None = None
    """Video of the chosen cameras side by side, over white."""
    camera: str = "all"
    """A camera of the capture, or `all`."""
    res: tuple[int, int] | None = None
    """Width and height in pixels; default: the capture's."""
    colorspace: str = "lin_rec709_scene"
    """Scene-linear colour space of the EXRs (an OCIO name or interop id)."""
    name: str = "avatar"
    """Name in the files."""

    def run(self) -> None:
        """Render every chosen camera and write every requested format."""
        if self.exr is None and self.png is None and self.mp4 is None:
            raise ConfigError("dsar render: nothing to write; give --exr DIR, --png DIR or --mp4 FILE")
        sequence, cameras, motion = self.open()
        cameras = self.choose(cameras)
        images = 0
        for frame, camera, output in self.images(sequence, cameras):
            self.write(frame, camera, output, sequence)
            images += 1
        if self.mp4 is not None:
            self.write_video(sequence, cameras)
        self.write_json({"motion": motion, "images": images, "cameras": [c.name for c in cameras]})

    def choose(self, cameras: Sequence[Camera]) -> list[Camera]:
        """Return the cameras to render, at the requested resolution."""
        names = [camera.name for camera in cameras]
        if self.camera != "all" and self.camera not in names:
            raise ConfigError(f"--camera {self.camera}: expected all or one of {', '.join(names)}")
        chosen = [camera for camera in cameras if self.camera in ("all", camera.name)]
        return [camera.resized(*self.res) if self.res else camera for camera in chosen]

    def images(
        self, sequence: GaussianSequence, cameras: list[Camera]
    ) -> Iterator[tuple[int, Camera, RenderOutput]]:
        """Yield the images for EXR and PNG, if any of them is wanted."""
        from dsar_render import render_sequence

        if self.exr is None and self.png is None:
            return iter(())
        made = render_sequence(sequence, cameras)
        return follow(made, len(sequence) * len(cameras), self.progress, "render")

    def write(self, frame: int, camera: Camera, output: RenderOutput, sequence: GaussianSequence) -> None:
        """Write one image in the requested formats."""
        from dsar_exporters import exr_path, write_exr
        from dsar_render import write_png

        if self.exr is not None:
            path = exr_path(self.exr, name=self.name, camera=camera.name, frame=frame)
            facts = {"fps": sequence.fps, "provenance": sequence.provenance, "colorspace": self.colorspace}
            write_exr(output, path, camera=camera, frame=frame, **facts)
        if self.png is not None:
            write_png(output, self.png / camera.name / f"{self.name}.{camera.name}.{frame:04d}.png")

    def write_video(self, sequence: GaussianSequence, cameras: list[Camera]) -> None:
        """Write the video of all chosen cameras side by side."""
        import numpy as np
        import torch

        from dsar_render import display_image, render_sequence, write_mp4

        assert self.mp4 is not None

        def rows() -> Iterator[np.ndarray]:
            row = []
            for _, _, output in render_sequence(sequence, cameras, background=torch.ones(3)):
                row.append(display_image(output))
                if len(row) == len(cameras):
                    yield np.concatenate(row, 1)
                    row = []

        write_mp4(follow(rows(), len(sequence), self.progress, "video"), self.mp4, fps=sequence.fps)


@dataclass(frozen=True)
class Eval(Common):
    """Measure a run on the frames it never saw; or train and measure the models of the paper's tables."""

    run_folder: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(name="run")] = None
    """Run folder; default: the newest under runs/."""
    ablations: bool = False
    """The paper's ablations instead of a run: trained, measured, and set beside the paper's figures."""
    baselines: bool = False
    """The paradigms of other systems, likewise."""
    capture: str = "embedded"
    """What tables are made on: a capture folder, or `embedded`."""
    minutes: float = 10.0
    """Training of each of a table's models."""
    hours: float | None = None
    """Stop before this time is over; the same command goes on with what is missing."""
    study: Path = Path("runs/study")
    """Folder of the tables' models; what it holds is not done again."""

    def run(self) -> None:
        """Measure and print the figures."""
        if self.ablations or self.baselines:
            self.run_study()
        else:
            self.run_heldout()

    def run_study(self) -> None:
        """Train and measure what the tables lack; print them."""
        from dsar.evaluation.study import ABLATIONS, BASELINES, Study, summarize_tables, to_markdown

        self.check_device()
        tables = (ABLATIONS if self.ablations else {}) | (BASELINES if self.baselines else {})
        study = Study(self.study, self.minutes, self.capture)
        with Bar(self.progress, "study").running() as bar:
            complete = study.run(list(tables.values()), self.hours, lambda what, share: bar.show(share, what))
        summary = summarize_tables(study, tables)
        self.write_json({"complete": complete, "minutes": self.minutes, "tables": summary})
        sys.stdout.write(to_markdown(summary))

    def run_heldout(self) -> None:
        """Measure one run."""
        from dsar.data.capture import open_capture
        from dsar.evaluation.heldout import evaluate
        from dsar.training.checkpoint import Run, load_checkpoint, newest_run

        self.check_device()
        run = Run(self.run_folder) if self.run_folder else newest_run()
        avatar, config, _ = load_checkpoint(run)
        figures = evaluate(avatar, open_capture(config.capture))
        self.write_json(figures)
        for split, values in figures["splits"].items():
            if values is not None:
                keys = ("psnr", "psnr_box", "psnr_box_template", "ssim")
                sys.stdout.write(
                    f"{split:6s} " + "  ".join(f"{key} {values[key]:.3f}" for key in keys) + "\n"
                )
        sys.stdout.write(f"one-to-many {figures['one_to_many']}\n")


@dataclass(frozen=True)
class Stress(Common):
    """Drive an avatar where rollouts fail."""

    run_folder: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(name="run")] = None
    """Run folder; default: the newest under runs/."""

    def run(self) -> None:
        """Run the battery on the held-out motion that is furthest from training; print each verdict."""
        from dsar.data.capture import open_capture
        from dsar.evaluation.stress import CASES, stress
        from dsar.training.checkpoint import Run, load_checkpoint, newest_run

        self.check_device()
        avatar, config, _ = load_checkpoint(Run(self.run_folder) if self.run_folder else newest_run())
        capture = open_capture(config.capture)
        verdicts = stress(avatar, capture.motions[capture_sequence(capture, "test") or ""])
        found = {}
        for name, verdict in follow(verdicts, len(CASES), self.progress, "stress"):
            found[name] = verdict.to_json()
            outcome = "passed" if verdict.passed else "FAILED"
            sys.stdout.write(f"{name:9s} {outcome}  {verdict.describe()}\n")
        survived = sum(case["pass"] for case in found.values())
        sys.stdout.write(f"{survived} of {len(found)} passed\n")
        self.write_json({"cases": found, "survived": survived, "tried": len(found)})


def shown(sequence: GaussianSequence, style: ProgressStyle, title: str) -> GaussianSequence:
    """Return the same sequence, showing progress as it is produced."""
    return dataclasses.replace(
        sequence, produce=lambda: follow(sequence.produce(), len(sequence), style, title)
    )


def capture_sequence(capture, motion: str) -> str | None:
    """Return the sequence that --motion names, None where it names a file.

    A split stands for its sequence furthest from training (labelled fd), else for its first.
    """
    if motion in capture.motions:
        return motion
    if motion in ("test", "train"):
        names = list(capture.splits[motion])
        return next((name for name in names if name in capture.splits.get("fd", ())), names[0])
    return None


def write_contact_sheet(folder: Path) -> Path:
    """Write truth above prediction for some frames and cameras of the run's test motion."""
    import numpy as np
    import torch

    from dsar.avatar import roll_out
    from dsar.avatar.rollout import START_FRAME
    from dsar.data.capture import open_capture
    from dsar.evaluation.heldout import true_view
    from dsar.training.checkpoint import Run, load_checkpoint
    from dsar_render import display_image, render_sequence, write_sheet

    avatar, config, _ = load_checkpoint(Run(folder))
    capture = open_capture(config.capture)
    name = capture_sequence(capture, "test") or ""
    length = len(capture.motions[name])
    frames = [START_FRAME + round(i * (length - 1) / 9) for i in range(10)]
    chosen = [0, len(capture.cameras) // 3, 2 * len(capture.cameras) // 3]
    cameras = [capture.cameras[i] for i in chosen]
    rows: dict[str, list[np.ndarray]] = {}
    for index, camera in zip(chosen, cameras, strict=True):
        truths = [true_view(capture, name, frame - START_FRAME, index).color for frame in frames]
        rows[f"{camera.name} truth"] = [(t.numpy() * 255).round().astype(np.uint8) for t in truths]
        rows[f"{camera.name} dsar"] = []
    sequence = roll_out(avatar, capture.motions[name], frames=frames)
    for _, camera, output in render_sequence(sequence, cameras, background=torch.ones(3)):
        rows[f"{camera.name} dsar"].append(display_image(output))
    columns = [f"{name} {frame}" for frame in frames]
    return write_sheet(folder / "previews" / "sheet.png", rows, columns=columns)


def parse(arguments: Sequence[str]) -> Train | Export | Render | Eval | Stress:
    """Return the command that the arguments ask for; the preset decides the other defaults."""
    preset = "demo"
    for flag, value in itertools.pairwise(arguments):
        if flag == "--preset" and value in PRESETS:
            preset = value
    chosen = PRESETS[preset]
    default = Train(atlas=chosen.atlas, model=chosen.model, loss=chosen.loss, schedule=chosen.schedule)
    commands = (
        Annotated[Train, tyro.conf.subcommand("train", default=default)]
        | Annotated[Export, tyro.conf.subcommand("export")]
        | Annotated[Render, tyro.conf.subcommand("render")]
        | Annotated[Eval, tyro.conf.subcommand("eval")]
        | Annotated[Stress, tyro.conf.subcommand("stress")]
    )
    return tyro.cli(commands, args=arguments, prog="dsar", description=__doc__)  # pyright: ignore


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command; a DsarError becomes one line on stderr and exit code 2."""
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    command = parse(sys.argv[1:] if arguments is None else arguments)
    try:
        command.run()
    except DsarError as error:
        sys.stderr.write(f"dsar: {error}\n")
        raise SystemExit(2) from error
    except KeyboardInterrupt:
        sys.stderr.write("dsar: interrupted; what was done is saved (continue with --resume)\n")
        raise SystemExit(130) from None


if __name__ == "__main__":
    main()
