"""PLY files of any records, written and read by plyfile."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import plyfile

NAMES = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()


COUNT = 400


def save(path: Path, vertices: np.ndarray, **how) -> Path:
    plyfile.PlyData([plyfile.PlyElement.describe(vertices, "vertex")], **how).write(path)
    return path


def retyped(vertices: np.ndarray, types: Callable[[str], str]) -> np.ndarray:
    return vertices.astype([(name, types(name)) for name in vertices.dtype.names])


def elements_of(path: Path) -> dict[str, np.ndarray]:
    return {element.name: element.data for element in plyfile.PlyData.read(path, mmap=False).elements}


def store(path: Path, elements: dict[str, np.ndarray]) -> Path:
    described = [plyfile.PlyElement.describe(records, name) for name, records in elements.items()]
    plyfile.PlyData(described).write(path)
    return path
