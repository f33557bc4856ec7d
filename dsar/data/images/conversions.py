"""What a capture's images are converted from: said once, not for every image."""

import logging
from collections.abc import Iterable
from dataclasses import dataclass, field

LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True)
class Note:
    """A conversion that a user is told of."""

    what: str
    """What images are and what becomes of them, in words that follow `photographs` or `masks`."""
    doubtful: bool = False
    """Whether it may not be what was meant."""


@dataclass
class ConversionLog:
    """Tells each conversion of a capture's images at the first of them."""

    capture: str
    """The capture's name."""
    _said: set[tuple[str, Note]] = field(default_factory=set)

    def log(self, kind: str, notes: Iterable[Note], first: str, share: str = "") -> None:
        """Log what was not said before.

        Args:
            kind: `photographs` or `masks`.
            notes: What happened to one of them.
            first: Its file.
            share: How many of them there are, in words.
        """
        for note in notes:
            if (kind, note) not in self._said:
                self._said.add((kind, note))
                level = logging.WARNING if note.doubtful else logging.INFO
                LOGGER.log(
                    level, "Capture %s: %s%s %s (first %s)", self.capture, kind, share, note.what, first
                )
