"""The `dsar` command: parse, build, call. Work and file formats live in the rooms that own them."""

import logging
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, redirect_stderr, redirect_stdout
from typing import Annotated, NoReturn

import tyro

from dsar.atomic_files import explain_os_error
from dsar.cli.check import Check
from dsar.cli.crosscheck import Crosscheck
from dsar.cli.eval import Eval
from dsar.cli.export import Export
from dsar.cli.render import Render
from dsar.cli.stress import Stress
from dsar.cli.train import Train
from dsar.config import PRESETS
from dsar.config.migrations import rename_flags
from dsar.errors import DsarError, RenderError, StorageError

Command = Train | Check | Export | Render | Eval | Stress | Crosscheck
_INTERRUPTED, _TERMINATED = 128 + signal.SIGINT, 128 + signal.SIGTERM
_NO_READER = 128 + signal.SIGPIPE


def parse(arguments: Sequence[str]) -> Command:
    """Return the command that the arguments ask for; the preset decides the other defaults."""
    arguments = rename_flags(arguments)
    command = _parse(arguments, "demo")
    if isinstance(command, Train) and command.preset != "demo":
        return _parse(arguments, command.preset)
    return command


def _parse(arguments: Sequence[str], preset: str) -> Command:
    """Return the command, with a preset's values for what is not said."""
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
    """Run a command; what goes wrong becomes one line on stderr.

    Exit codes: 2 where an input, a setting or the system is at fault, 1 where a part of a batch failed, 130
    where the command was interrupted, 143 where it was terminated.
    """
    level = logging.INFO if _is_first_rank() else logging.ERROR
    logging.basicConfig(level=level, format="%(message)s", stream=sys.stderr)
    try:
        with nullcontext() if _is_first_rank() else _silent():
            command = parse(sys.argv[1:] if arguments is None else arguments)
        with _cleaning_up_when_terminated():
            command.check_outputs_writable()
            _run(command)
    except DsarError as error:
        # What was done of a batch is there; what was asked for was right.
        _leave(str(error), 1 if isinstance(error, RenderError) else 2, error)
    except BrokenPipeError:
        # Whoever read our output has seen enough; Python would complain again when it closes it.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(_NO_READER) from None
    except KeyboardInterrupt:
        _leave("interrupted before any work", _INTERRUPTED)
    except OSError as error:
        what = f"{error.filename}: " if error.filename else ""
        _leave(what + explain_os_error(error), 2, error)


def _run(command: Command) -> None:
    """Run a command, and say what it leaves where it is stopped in its midst."""
    try:
        command.run()
    except StorageError as error:
        raise StorageError(f"{error}; {command.describe_remains()}") from error
    except KeyboardInterrupt:
        _leave(f"interrupted; {command.describe_remains()}", _INTERRUPTED)
    except SystemExit as stop:
        if stop.code == _TERMINATED:
            _leave(f"terminated; {command.describe_remains()}", _TERMINATED)
        raise


def _leave(message: str, code: int, cause: BaseException | None = None) -> NoReturn:
    """Write one line and end with an exit code; of ranks that end together one writes it."""
    if "RANK" not in os.environ or _takes_the_word():
        sys.stderr.write(f"dsar: {' '.join(message.split())}\n")
    raise SystemExit(code) from cause


def _takes_the_word() -> bool:
    from dsar.training.launch import takes_the_word

    return takes_the_word()


def _is_first_rank() -> bool:
    """Return whether this process is one that speaks of what all ranks meet (`dsar.training.launch`)."""
    return os.environ.get("RANK", "0") == "0"


@contextmanager
def _silent() -> Iterator[None]:
    with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
        yield
