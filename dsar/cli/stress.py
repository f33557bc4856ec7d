"""`dsar stress`."""

import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from dsar.cli.command import GuardedCommand, resolve_sequence
from dsar.console import track_progress
from dsar.errors import ConfigError

if TYPE_CHECKING:
    from dsar.evaluation.stress import Moment

_SIZE = (144, 192)
"""Pixels of a picture of a worst moment, wide and high."""


@dataclass(frozen=True)
class Stress(GuardedCommand):
    """Drive an avatar where rollouts fail; exit with 1 where a case does."""

    cases: tuple[str, ...] = ()
    """Only these of the cases, by name, as `twin stop rate`; the run's page stays as it is. Default: all."""

    def output_folders(self) -> list[Path]:
        """Return the run, which keeps its verdicts and report."""
        return [self.chosen_run()]

    def run(self) -> None:
        """Run the battery on the held-out motion that is furthest from training; print each verdict."""
        from dsar.atomic_files import write_text_atomically
        from dsar.evaluation.report import write_report
        from dsar.evaluation.stress import CASES, BatteryVerdict, stress
        from dsar.evaluation.stress.analysis import analyse, describe_analysis, reported_motions
        from dsar.training.checkpoint import Run, load_checkpoint
        from dsar.training.scene import open_scene

        chosen = {name: CASES[name] for name in CASES if name in self.cases or not self.cases}
        if unknown := set(self.cases) - set(CASES):
            raise ConfigError(
                f"--cases: no case {', '.join(sorted(unknown))}; expected some of {', '.join(CASES)}"
            )
        device = self.chosen_device()
        run = Run(self.chosen_run())
        avatar, config, _ = load_checkpoint(run, device)
        scene = open_scene(run, config)
        self.guard(run, avatar, lambda: scene)
        motion = scene.motions[resolve_sequence(scene, "test") or ""]
        cases, seconds, start = {}, {}, time.perf_counter()
        for name, verdict in track_progress(
            stress(avatar, motion, chosen), len(chosen), self.progress, "stress"
        ):
            cases[name], seconds[name] = verdict, time.perf_counter() - start
            outcome = "passed" if verdict.passed else "FAILED"
            sys.stdout.write(f"{name:9s} {outcome}  {verdict.describe()}  ({seconds[name]:.0f} s)\n")
            if verdict.moment is not None:
                _write_moment(run.stress_pictures / f"{name}.png", name, verdict.moment)
            start = time.perf_counter()
        battery = BatteryVerdict(cases, seconds)
        content = battery.to_json()
        if not self.cases:
            analysis = analyse(avatar, motion, reported_motions(scene))
            content |= {"analysis": analysis.to_json()}
            for line in describe_analysis(analysis):
                sys.stdout.write(line + "\n")
        sys.stdout.write(f"{battery.survived} of {len(cases)} passed\n")
        self.write_json(content)
        if not self.cases:
            write_text_atomically(run.stress, json.dumps(content, indent=2) + "\n")
            write_report(run)
        if battery.survived < len(cases):
            raise SystemExit(1)


def _write_moment(path: Path, name: str, moment: "Moment") -> None:
    """Write pictures of a case's worst moment, side by side; the camera goes where the body goes."""
    from dsar.evaluation.stress.pictures import draw_followed
    from dsar_render import write_contact_sheet

    pictures = [draw_followed(gaussians, _SIZE) for gaussians in moment.gaussians]
    write_contact_sheet(path, {name: pictures}, columns=[f"frame {frame}" for frame in moment.frames])
