"""Which Mitsuba a machine gets, and that a wrong LLVM harms nobody."""

from pathlib import Path

import pytest

from dsar.errors import ConfigError, MissingDependencyError
from dsar_render.crosscheck import backend


@pytest.fixture(autouse=True)
def forgetful():
    backend.find_llvm.cache_clear()
    yield
    backend.find_llvm.cache_clear()


def test_newer_libraries_are_tried_first(monkeypatch, tmp_path):
    for name in ("libLLVM-14.0.6.so.1", "libLLVM-15.so.1", "libLLVM.so.19.1", "libLLVM.so.9.1"):
        (tmp_path / name).touch()
    (tmp_path / "libLLVM-19.so").symlink_to("libLLVM.so.19.1")
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    monkeypatch.setattr(backend, "_FOLDERS", (str(tmp_path),))
    names = [path.name for path in backend.candidates()]
    assert names == ["libLLVM.so.19.1", "libLLVM-15.so.1", "libLLVM-14.0.6.so.1", "libLLVM.so.9.1"]


def test_the_library_that_the_environment_names_is_the_only_candidate(monkeypatch):
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", "/opt/libLLVM.so")
    assert list(backend.candidates()) == [Path("/opt/libLLVM.so")]


# What Debian ships; 14 is refused, 15 and 16 abort at the first kernel.
OTHERS = sorted(Path("/usr/lib").glob("*/libLLVM-1[456].so.1"))


@pytest.mark.parametrize("library", [*OTHERS, Path("/nowhere/libLLVM.so.19.1")], ids=lambda path: path.name)
def test_a_library_that_does_not_work_is_passed_over_for_scalar(monkeypatch, library):
    pytest.importorskip("mitsuba")
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(library))
    assert backend.find_llvm() is None
    assert backend.load_mitsuba().variant() == backend.SCALAR
    with pytest.raises(ConfigError, match="libllvm19"):
        backend.load_mitsuba(backend.LLVM)


def test_without_mitsuba_the_extra_is_named(monkeypatch):
    monkeypatch.setattr(backend.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingDependencyError, match=r"dsar-avatar\[mitsuba\]"):
        backend.load_mitsuba()


def test_variants_that_do_not_exist_are_refused():
    with pytest.raises(ConfigError, match="expected llvm_ad_rgb or scalar_rgb, found cuda"):
        backend.load_mitsuba("cuda")
