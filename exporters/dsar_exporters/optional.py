"""Packages that only one feature needs, imported when it is asked for."""

import importlib
from types import ModuleType

from dsar.errors import MissingDependencyError


def require(module: str, *, feature: str, package: str, extra: str) -> ModuleType:
    """Import a module of an optional package.

    Raises:
        MissingDependencyError: The package is not installed; the message says which extra brings it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingDependencyError(feature, package, extra) from error
