"""A rez package of DSAR: copy it to the root of a checkout, and `rez build --install` there.

What it requires are rez packages of the same names; `rez pip --install NAME` makes those a studio has not.
"""

name = "dsar"
version = "0.1.0"
description = "Gaussian avatars whose clothes have memory"
requires = [
    "python-3.11+",
    "numpy-1.26+<3",
    "torch-2.8+",
    "numba",
    "cma",
    "jaxtyping",
    "jinja2",
    "plotly",
    "pillow",
    "rich",
    "safetensors",
    "tyro",
    "fileseq",
]
variants = [
    ["usd-26.3+", "openexr-3.3+", "openimageio-3+", "mmh3-4+", "plyfile", "gsply", "fourdgs", "zstandard"]
]
build_command = "python -m pip install --no-deps --target {install_path}/python {root}"


def commands():
    """Set what the command and the Python API need."""
    env.PYTHONPATH.append("{root}/python")  # rez provides it
    env.PATH.append("{root}/python/bin")
