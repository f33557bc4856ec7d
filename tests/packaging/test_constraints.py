import importlib.metadata
import re
from pathlib import Path

import pytest
from packaging.requirements import Requirement

CONSTRAINTS = Path(__file__).parents[2] / "constraints.txt"


def read_constraints():
    """The constraints that hold on this platform, by normalised name."""
    lines = (line.split("#")[0].strip() for line in CONSTRAINTS.read_text().splitlines())
    requirements = [Requirement(line) for line in lines if line]
    return {normalize_name(r.name): r for r in requirements if r.marker is None or r.marker.evaluate()}


def normalize_name(name):
    """The name under which package indexes compare distributions (PEP 503)."""
    return re.sub(r"[-_.]+", "-", name).lower()


def list_dependencies(extras):
    """Every distribution that dsar-avatar with these extras needs here, directly or not."""
    pending, seen = [("dsar-avatar", extra) for extra in extras], set()
    while pending:
        name, extra = pending.pop()
        if (name, extra) in seen:
            continue
        seen.add((name, extra))
        for line in importlib.metadata.requires(name) or ():
            requirement = Requirement(line)
            if requirement.marker is None or requirement.marker.evaluate({"extra": extra}):
                child = normalize_name(requirement.name)
                pending += [(child, extra) for extra in ("", *requirement.extras)]
    return {name for name, _ in seen} - {"dsar-avatar"}


@pytest.mark.parametrize(("extra", "module"), [("dev", "pytest"), ("gpu", "warp")])
def test_every_dependency_is_pinned_exactly(extra, module):
    pytest.importorskip(module)
    constraints = read_constraints()
    assert list_dependencies(["", extra]) - constraints.keys() == set()
    assert all(str(r.specifier).startswith("==") for r in constraints.values())


def test_linux_pins_a_torch_that_cannot_be_the_cuda_build():
    lines = [line for line in CONSTRAINTS.read_text().splitlines() if line.startswith("torch==")]
    linux = [r for r in map(Requirement, lines) if r.marker and r.marker.evaluate({"sys_platform": "linux"})]
    assert [str(r.specifier) for r in linux] == ["==2.13.0+cpu"]


@pytest.mark.parametrize("name", ["nvidia", "triton", "cuda"])
def test_no_cuda_package_is_pinned(name):
    assert not [pinned for pinned in read_constraints() if pinned.startswith(name)]
