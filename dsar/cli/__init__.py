"""The `dsar` command: parse, build, call. Work and file formats live in the rooms that own them."""

import itertools
import logging
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Annotated

import tyro

from dsar.cli.check import Check
from dsar.cli.crosscheck import Crosscheck
from dsar.cli.export import Export
from dsar.cli.measure import Eval, Stress
from dsar.cli.render import Render
from dsar.cli.train import Train
from dsar.config import PRESETS
from dsar.errors import DsarError, RenderError


def parse(arguments: Sequence[str]) -> Train | Check | Export | Render | Eval | Stress | Crosscheck:
    """Return the command that the arguments ask for; the preset decides the other defaults."""
    preset = "demo"
    for flag, value in itertools.pairwise(arguments):
        if flag == "--preset" and value in PRESETS:
            preset = value
    chosen = PRESETS[preset]
    default = Train(atlas=chosen.atlas, model=chosen.model, loss=chosen.loss, schedule=chosen.schedule)
    commands = (
        Annotated[Train, tyro.conf.subcommand("train", default=default)]
        | Annotated[Check, tyro.conf.subcommand("check")]
        | Annotated[Export, tyro.conf.subcommand("export")]
        | Annotated[Render, tyro.conf.subcommand("render")]
        | Annotated[Eval, tyro.conf.subcommand("eval")]
        | Annotated[Stress, tyro.conf.subcommand("stress")]
        | Annotated[Crosscheck, tyro.conf.subcommand("crosscheck")]
    )
    return tyro.cli(commands, args=arguments, prog="dsar", description=__doc__)  # pyright: ignore


@contextmanager
def _cleaning_up_when_terminated() -> Iterator[None]:
    """Let SIGTERM, a farm's way to stop a job, end the command with code 143 and no drafts left behind."""

    def leave(number: int, _: object) -> None:
        raise SystemExit(128 + number)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command; a DsarError becomes one line on stderr and exit code 2."""
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    command = parse(sys.argv[1:] if arguments is None else arguments)
    try:
        with _cleaning_up_when_terminated():
            command.run()
    except DsarError as error:
        sys.stderr.write(f"dsar: {error}\n")
        # What was done of a batch is there; what was asked for was right.
        raise SystemExit(1 if isinstance(error, RenderError) else 2) from error
    except KeyboardInterrupt:
        sys.stderr.write("dsar: interrupted; what was done is saved (continue with --resume)\n")
        raise SystemExit(130) from None
