"""`dsar eval`."""

import json
import sys
from dataclasses import dataclass
from pathlib import Path

from dsar.cli.command import RunCommand
from dsar.cli.previews import write_worst
from dsar.config import ScheduleConfig
from dsar.console import ProgressBar
from dsar.errors import ConfigError


@dataclass(frozen=True)
class Eval(RunCommand):
    """Measure a run on the frames it never saw; or train and measure the models of the paper's tables."""

    ablations: bool = False
    """The paper's ablations instead of a run: trained, measured, and set beside the paper's figures."""
    baselines: bool = False
    """The paradigms of other systems, likewise."""
    capture: str = "embedded"
    """What tables are made on: a capture folder, `embedded` or `embedded-wool`."""
    tables: tuple[str, ...] = ()
    """Only these of the tables, by name, as `ablation memories`."""
    steps: int = ScheduleConfig.steps
    """Updates of each of a table's models."""
    hours: float | None = None
    """Stop before this time is over; the same command goes on with what is missing."""
    study: Path = Path("runs/study")
    """Folder of the tables' models; what it holds is not done again."""
    chart: Path | None = None
    """Draw the tables' models, speed against accuracy, to this file (.svg, .png)."""

    def output_files(self) -> list[Path]:
        """Return the chart."""
        return [] if self.chart is None else [self.chart]

    def output_folders(self) -> list[Path]:
        """Return the folder of the tables' models, or the run, which keeps its figures and report."""
        return [self.study if self.is_study else self.chosen_run()]

    def describe_remains(self) -> str:
        """Return what is left."""
        return (
            "models that were measured stay; the same command goes on"
            if self.is_study
            else super().describe_remains()
        )

    @property
    def is_study(self) -> bool:
        """Whether tables are made."""
        return self.ablations or self.baselines

    def run(self) -> None:
        """Measure and print the figures."""
        if self.is_study:
            self.run_study()
        else:
            self.run_heldout()

    def run_study(self) -> None:
        """Train and measure what the tables lack; print them."""
        from dsar.atomic_files import write_text_atomically
        from dsar.config import absolute_capture
        from dsar.evaluation.study import ABLATIONS, BASELINES, Study, summarize_tables, to_markdown
        from dsar.evaluation.study.chart import chart_points, draw_chart, training_length_series

        device = self.chosen_device()
        every = ABLATIONS | BASELINES
        tables = (ABLATIONS if self.ablations else {}) | (BASELINES if self.baselines else {})
        if unknown := set(self.tables) - set(tables):
            raise ConfigError(f"no table {', '.join(sorted(unknown))}; there are {', '.join(tables)}")
        tables = {name: table for name, table in tables.items() if name in self.tables or not self.tables}
        capture = absolute_capture(self.capture)
        study = Study(self.study, self.steps, capture, device=device)
        with ProgressBar(self.progress, "study").running() as bar:
            complete = study.run(list(tables.values()), self.hours, lambda what, share: bar.show(share, what))
        summary = summarize_tables(study, tables)
        facts = {"complete": complete, "steps": self.steps, "capture": capture}
        self.write_json(facts | {"tables": summary})
        content = facts | {"tables": summarize_tables(study, every)}
        write_text_atomically(self.study / "study.json", json.dumps(content, indent=1) + "\n")
        sys.stdout.write(to_markdown(summary))
        if not complete:
            sys.stdout.write("\nNot complete: the same command goes on with what is missing.\n")
        points = chart_points(summary)
        if self.chart is not None and points:
            draw_chart(points, training_length_series(summary), self.chart)

    def run_heldout(self) -> None:
        """Measure one run."""
        from dsar.atomic_files import write_text_atomically
        from dsar.evaluation.heldout import evaluate
        from dsar.evaluation.report import write_report
        from dsar.evaluation.unseen import describe_unseen
        from dsar.training.checkpoint import Run, load_checkpoint
        from dsar.training.scene import open_images

        device = self.chosen_device()
        run = Run(self.chosen_run())
        avatar, config, _ = load_checkpoint(run, device)
        figures = evaluate(avatar, open_images(run, config))
        content = figures.to_json()
        self.write_json(content)
        write_worst(run.folder, figures.worst, device)
        write_text_atomically(run.figures, json.dumps(content, indent=2) + "\n")
        write_report(run)
        for split, metrics in content["splits"].items():
            if metrics is not None:
                keys = ("psnr", "psnr_box", "psnr_box_template", "ssim")
                sys.stdout.write(
                    f"{split:6s} " + "  ".join(f"{key} {metrics[key]:.3f}" for key in keys) + "\n"
                )
        sys.stdout.write(f"one-to-many {content['one_to_many']}\n")
        for split, unseen in (figures.unseen or {}).items():
            sys.stdout.write(describe_unseen(split, unseen) + "\n")
