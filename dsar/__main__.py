"""`python -m dsar` is the `dsar` command."""

import signal


def main() -> None:
    """Run the command; an interrupt while its packages are loaded ends it as one in its midst does."""
    try:
        from dsar.cli import main as run
    except KeyboardInterrupt:
        raise SystemExit(128 + signal.SIGINT) from None
    run()


if __name__ == "__main__":
    main()
