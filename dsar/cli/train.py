"""`dsar train`."""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from dsar.cli.command import Common
from dsar.cli.previews import write_previews
from dsar.config import PRESETS, AtlasConfig, LossConfig, ModelConfig, ScheduleConfig, TrainConfig
from dsar.console import ProgressBar
from dsar.errors import ConfigError, TrainingError

if TYPE_CHECKING:
    import torch

    from dsar.training.report import Report


@dataclass(frozen=True)
class Train(Common):
    """Learn an avatar from a capture."""

    capture: tyro.conf.Positional[str] = "embedded"
    """A capture folder in any supported format, `embedded` or `embedded-wool`."""
    preset: Literal["demo", "small", "paper"] = "demo"
    """Settings to start from; every other flag overrides them."""
    out: Path | None = None
    """Run folder; default runs/<preset>."""
    body: Path | None = None
    """SMPL-X model file (.npz, .pkl), or a folder of SMPLX_<GENDER> files; default: the capture's own, or
    $DSAR_BODY where its format brings none, else the embedded body."""
    train_frames: str | None = None
    """Frames of each training sequence, e.g. 0-239."""
    test_frames: str | None = None
    """Frames of each test sequence, e.g. 250-359."""
    cameras: int | None = None
    """Cameras to learn from, spread as far as can be; default: all."""
    steps: int | None = None
    """Updates in all."""
    minutes: float | None = None
    """Limit on the time; where a machine is too slow for it, the schedule is compressed to fit."""
    workers: int | None = None
    """Processes, one core each; torchrun starts them itself, and says how many."""
    resume: bool = False
    """Go on with the run in --out."""
    seed: int = 0
    """Seed of everything random."""
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
            workers=self._worker_count(preset.workers),
            atlas=self.atlas,
            model=self.model,
            loss=self.loss,
            schedule=schedule,
        )

    def _worker_count(self, usual: int) -> int:
        """Return how many processes train; a ConfigError where flag and torchrun disagree."""
        from dsar.training.launch import launched

        launch = launched()
        if launch is None:
            return usual if self.workers is None else self.workers
        if self.workers not in (None, launch.world_size):
            raise ConfigError(
                f"--workers {self.workers}: torchrun started {launch.world_size}; leave --workers out"
            )
        return launch.world_size

    def check_outputs_writable(self) -> None:
        """Check it where it is written: alone, or in the first rank."""
        from dsar.training.launch import is_first

        if is_first():
            super().check_outputs_writable()

    def output_folders(self) -> list[Path]:
        """Return the run's folder."""
        return [self.folder]

    @property
    def folder(self) -> Path:
        """The run's folder."""
        return self.out or Path("runs") / self.preset

    def describe_remains(self) -> str:
        """Return up to where training is saved."""
        from dsar.training.checkpoint import Run, read_progress

        run = Run(self.folder)
        if not run.exists:
            return "no checkpoint was written yet"
        step = read_progress(run).step
        return f"training is saved up to update {step} in {run.checkpoint}; --resume goes on from there"

    def run(self) -> None:
        """Train, then leave pictures and a report; of several ranks only the first does that."""
        from dsar.training import launch
        from dsar.training.checkpoint import Run

        device, config = launch.own_device(self.device), self.config()
        with launch.joined(device):
            if not launch.from_first(Run(self.folder).checkpoint.exists):
                launch.from_first(lambda: _refuse_unusable_images(config))
            last = self._train(config, device)
        if launch.is_first():
            self._show_results(last, device)

    def _train(self, config: TrainConfig, device: "torch.device") -> "list[Report]":
        """Train, and return the last report, where this process gets one."""
        from dsar.training.checkpoint import Run
        from dsar.training.launch import is_first, launched
        from dsar.training.loop import train
        from dsar.training.report import Report

        last: list[Report] = []
        with ProgressBar(self.progress if is_first() else "none", "train").running() as bar:

            def report(line: Report) -> None:
                last[:] = [line]
                left = "" if line.seconds_left is None else f" {line.seconds_left:.0f} s left"
                numbers = f"loss {line.loss:.4f} PSNR {line.psnr:.2f} dB"
                bar.show(line.progress, f"{line.stage} step {line.step} {numbers}{left}")

            try:
                train(config, Run(self.folder), resume=self.resume, report=report, device=device)
            except TrainingError as error:
                if launched() is None:
                    raise
                raise TrainingError(f"{error}; {self.describe_remains()}") from error
        return last

    def _show_results(self, last: "list[Report]", device: "torch.device") -> None:
        from dsar.training.checkpoint import Run, load_checkpoint, read_progress
        from dsar.training.guard_limits import attach_guards
        from dsar.training.scene import open_scene

        run = Run(self.folder)
        avatar, config, _ = load_checkpoint(run, device)
        attach_guards(run, avatar, lambda: open_scene(run, config))
        sheet = write_previews(run.folder, device)
        reached = dataclasses.asdict(last[-1] if last else read_progress(run))
        self.write_json({"run": str(run.folder), "sheet": str(sheet), **reached})


def _refuse_unusable_images(config: TrainConfig) -> None:
    from dsar.data.captures.formats import capture_of
    from dsar.evaluation.check import refuse_unusable_images

    refuse_unusable_images(capture_of(config).with_cameras(config.cameras))
