"""What `dsar check` finds."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """Something that is wrong."""

    name: str
    """A word for it, stable."""
    what: str
    """What, where, and what to do."""
    fatal: bool = False
    """Whether the capture cannot train."""
