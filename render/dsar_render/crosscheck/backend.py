"""Mitsuba in a variant that works on this machine.

`llvm_ad_rgb` traces splats and differentiates, but needs an LLVM that no wheel brings, and with the wrong one
ends the process: LLVM 15 and 16 are accepted and abort at the first kernel. So each candidate is tried in
another process. `scalar_rgb` needs nothing and traces meshes only.
"""

import contextlib
import importlib.util
import os
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import ModuleType

from dsar.errors import ConfigError, MissingDependencyError

LLVM, SCALAR = "llvm_ad_rgb", "scalar_rgb"
_LIBRARY = "DRJIT_LIBLLVM_PATH"
_FOLDERS = ("/usr/lib/x86_64-linux-gnu", "/usr/lib/aarch64-linux-gnu", "/usr/lib64", "/usr/lib/llvm-*/lib")
_SOUND = 17
"""Versions below abort at the first kernel."""
_TRIAL_S = 60.0
_TRIAL = """
import resource
resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # whoever aborts leaves no memory image behind
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
sensor = {"type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 8}}
light, ball = {"type": "constant"}, {"type": "sphere", "center": [0, 0, 4]}
scene = mi.load_dict({"type": "scene", "integrator": {"type": "direct"}, "s": sensor, "l": light, "b": ball})
assert float(mi.render(scene, spp=4).numpy().sum()) > 0
"""


def load_mitsuba(variant: str | None = None) -> ModuleType:
    """Return Mitsuba, set to `llvm_ad_rgb` where that works and to `scalar_rgb` where it does not.

    Args:
        variant: One of the two, to have no other.

    Raises:
        ConfigError: `llvm_ad_rgb` is asked for and no LLVM works.
        MissingDependencyError: Mitsuba is not installed.
    """
    if variant not in (None, LLVM, SCALAR):
        raise ConfigError(f"Mitsuba's variant: expected {LLVM} or {SCALAR}, found {variant}")
    library = find_llvm() if variant != SCALAR else None
    if library is not None and "drjit" not in sys.modules:
        # Dr.Jit reads it when it is imported, and otherwise takes what it finds itself.
        os.environ[_LIBRARY] = str(library)
    mi = _import()
    if library is not None:
        # Whoever loaded Dr.Jit before may have given it an older one, which it refuses.
        with contextlib.suppress(ImportError):
            mi.set_variant(LLVM)
            if _loaded_version() >= _SOUND:
                return mi
    if variant == LLVM and library is not None:
        raise ConfigError(
            f"Mitsuba: expected to start with {library}, found that Dr.Jit was loaded before with another "
            f"LLVM: set ${_LIBRARY}={library} before Python starts"
        )
    if variant == LLVM:
        raise ConfigError(
            "Mitsuba: expected an LLVM that it works with, found none: install libllvm19 "
            f"(apt-get install libllvm19), or name one in ${_LIBRARY}"
        )
    mi.set_variant(SCALAR)
    return mi


@cache
def find_llvm() -> Path | None:
    """Return the library of the newest LLVM with which Mitsuba renders here, None if there is none."""
    if importlib.util.find_spec("mitsuba") is None:
        raise MissingDependencyError("dsar crosscheck", "mitsuba", "mitsuba")
    return next((library for library in candidates() if _renders_with(library)), None)


def candidates() -> Iterator[Path]:
    """Yield LLVM's libraries: the one that the environment names, else those of the system, newest first."""
    if named := os.environ.get(_LIBRARY):
        yield Path(named)
        return
    libraries = {
        file.resolve()
        for folder in _FOLDERS
        for file in Path("/").glob(f"{folder[1:]}/libLLVM*.so*")
        if file.exists()
    }
    yield from sorted(libraries, key=_version, reverse=True)


def _version(library: Path) -> tuple[int, ...]:
    """Return the numbers in a library's name: libLLVM.so.19.1, libLLVM-14.0.6.so.1."""
    name = library.name.removeprefix("libLLVM").removeprefix("-").removeprefix(".so.")
    return tuple(int(part) for part in name.split(".") if part.isdigit())


def _renders_with(library: Path) -> bool:
    trial = [sys.executable, "-c", _TRIAL]
    environment = os.environ | {_LIBRARY: str(library)}
    with contextlib.suppress(subprocess.TimeoutExpired):
        done = subprocess.run(trial, env=environment, capture_output=True, timeout=_TRIAL_S, check=False)
        return done.returncode == 0
    return False


def _loaded_version() -> int:
    """Return the major version of the LLVM that this process has."""
    import drjit

    return drjit.detail.llvm_version()[0]


def _import() -> ModuleType:
    try:
        import mitsuba
    except ImportError as error:
        raise MissingDependencyError("dsar crosscheck", "mitsuba", "mitsuba") from error
    return mitsuba
