"""What systems do to programs: no room, no permission, half a file. For tests of what is said then."""

import contextlib
import ctypes
import os
import resource
import struct
from pathlib import Path

_PAST_PERMISSIONS = (1, 2)
"""CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH: with them permissions mean nothing."""
_HEADER = struct.pack("=Ii", 0x20080522, 0)


@contextlib.contextmanager
def full_disk(room):
    """Let no file grow beyond so many bytes: to the program it is the same as a disk that is full."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@contextlib.contextmanager
def read_only(folder):
    """Take write permission from a folder and all below it, and from a superuser the power to ignore that."""
    folders = [Path(folder), *(path for path in Path(folder).rglob("*") if path.is_dir())]
    for each in folders:
        each.chmod(0o555)
    before = _capabilities()
    _set_capabilities(before[0] & ~sum(1 << bit for bit in _PAST_PERMISSIONS), *before[1:])
    try:
        assert not os.access(folder, os.W_OK, effective_ids=True)
        yield
    finally:
        _set_capabilities(*before)
        for each in folders:
            each.chmod(0o755)


def cut(path, size):
    """Keep the first bytes of a file."""
    os.truncate(path, size)
    return path


def contents(folder):
    """Return every file below a folder with what is in it."""
    return {path: path.read_bytes() for path in Path(folder).rglob("*") if path.is_file()}


def _capabilities():
    """Return what this thread may do as bits: effective, permitted, inheritable."""
    data = ctypes.create_string_buffer(24)
    if ctypes.CDLL(None, use_errno=True).capget(_HEADER, data):
        raise OSError(ctypes.get_errno(), "capget")
    low, high = struct.unpack("=3I", data.raw[:12]), struct.unpack("=3I", data.raw[12:])
    return tuple(a | b << 32 for a, b in zip(low, high, strict=True))


def _set_capabilities(*bits):
    low, high = ([each >> shift & 0xFFFFFFFF for each in bits] for shift in (0, 32))
    if ctypes.CDLL(None, use_errno=True).capset(_HEADER, struct.pack("=6I", *low, *high)):
        raise OSError(ctypes.get_errno(), "capset")
