"""`dsar stress`."""

import json
import sys
from dataclasses import dataclass
from pathlib import Path

from dsar.cli.command import GuardedCommand, resolve_sequence
from dsar.console import track_progress


@dataclass(frozen=True)
class Stress(GuardedCommand):
    """Drive an avatar where rollouts fail."""

    def output_folders(self) -> list[Path]:
        """Return the run, which keeps its verdicts and report."""
        return [self.chosen_run()]

    def run(self) -> None:
        """Run the battery on the held-out motion that is furthest from training; print each verdict."""
        from dsar.atomic_files import write_text_atomically
        from dsar.evaluation.report import write_report
        from dsar.evaluation.stress import CASES, BatteryVerdict, stress
        from dsar.training.checkpoint import Run, load_checkpoint
        from dsar.training.scene import open_scene

        device = self.chosen_device()
        run = Run(self.chosen_run())
        avatar, config, _ = load_checkpoint(run, device)
        scene = open_scene(run, config)
        self.guard(run, avatar, lambda: scene)
        verdicts = stress(avatar, scene.motions[resolve_sequence(scene, "test") or ""], CASES)
        cases = {}
        for name, verdict in track_progress(verdicts, len(CASES), self.progress, "stress"):
            cases[name] = verdict
            outcome = "passed" if verdict.passed else "FAILED"
            sys.stdout.write(f"{name:9s} {outcome}  {verdict.describe()}\n")
        battery = BatteryVerdict(cases)
        sys.stdout.write(f"{battery.survived} of {len(cases)} passed\n")
        self.write_json(battery.to_json())
        write_text_atomically(run.stress, json.dumps(battery.to_json(), indent=2) + "\n")
        write_report(run)
