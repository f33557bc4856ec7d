"""Collect what benchmarks/gpu.py needs on a machine without a network, in 64 MiB at most.

    python tools/pack_gpu_benchmark.py DIR [--gsplat ARCHIVE] [--architecture 90]

The machine has torch for CUDA, NumPy, Numba, Pillow, safetensors and, for gsplat, nvcc and ninja. Pure Python
packages that it may lack come along in `site`. gsplat comes as source: from an archive, else by pip. Warp's
kernels come as PTX where Warp is installed here; Warp itself (a wheel of 149 MB) does not fit and must be
there. `run.sh` in the folder runs everything.
"""

import argparse
import importlib
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
from importlib.metadata import distribution
from pathlib import Path

ROOT = Path(__file__).parents[1]
LIMIT = 64 << 20
"""Bytes."""
SEQUENCES = ("spin_jump", "walk", "far")
"""Sequences of the embedded capture that the benchmark reads, and the one that its pairs of frames name."""
PURE = ("cma", "fileseq", "jaxtyping", "wadler_lindig")
"""Packages without compiled parts, taken from this installation."""
GSPLAT = "gsplat==1.5.3"
KERNELS = ("projection", "binning", "compositing", "extras")
RUN = """#!/usr/bin/env bash
# Measures; arguments go to benchmarks/gpu.py. Results are written to gpu.json, row by row.
set -euo pipefail
cd "$(dirname "$0")"
export PYTHONPATH="$PWD:$PWD/site${PYTHONPATH:+:$PYTHONPATH}"
exec python3 benchmarks/gpu.py --json "${OUT:-.}/gpu.json" "$@"
"""


def main() -> None:
    """Collect, say what is in the folder, and refuse what is too large."""
    parser = argparse.ArgumentParser(description="Collect what benchmarks/gpu.py needs without a network.")
    parser.add_argument("folder", type=Path, metavar="DIR", help="a new folder")
    parser.add_argument("--gsplat", type=Path, metavar="ARCHIVE", help="gsplat's sources (.tar.gz)")
    parser.add_argument("--architecture", type=int, default=90, help="of the GPU, for PTX: 90 is sm_90")
    arguments = parser.parse_args()
    folder = arguments.folder
    if folder.exists():
        parser.error(f"{folder} exists already")
    (folder / "site").mkdir(parents=True)
    notes = [copy_sources(folder), copy_capture(folder), *(copy_package(name, folder) for name in PURE)]
    notes += [unpack_gsplat(arguments.gsplat, folder), compile_kernels(folder, arguments.architecture)]
    (folder / "run.sh").write_text(RUN)
    (folder / "run.sh").chmod(0o755)
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    print(*notes, f"{folder}: {size / 2**20:.1f} MiB of {LIMIT >> 20}", sep="\n")
    if size > LIMIT:
        shutil.rmtree(folder)
        sys.exit(f"refused: more than {LIMIT >> 20} MiB; nothing was kept")


def copy_sources(folder: Path) -> str:
    """Copy our code, the body and the licences."""
    ignored = shutil.ignore_patterns("__pycache__", "embedded*", "results", "rivals", "priors")
    for name in ("dsar", "benchmarks"):
        shutil.copytree(ROOT / name, folder / name, ignore=ignored)
    for name in ("LICENSE", "NOTICE"):
        shutil.copy(ROOT / name, folder)
    return "ours: dsar, benchmarks, the body, licences"


def copy_capture(folder: Path) -> str:
    """Copy a part of the embedded capture."""
    source, target = ROOT / "dsar/data/embedded", folder / "dsar/data/embedded"
    record = json.loads((source / "capture.json").read_text())
    record["sequences"] = {name: record["sequences"][name] for name in SEQUENCES}
    for entry in record["sequences"].values():
        for part in ("motion", "images", "garment"):
            (target / entry[part]).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(source / entry[part], target / entry[part])
    (target / "capture.json").write_text(json.dumps(record, indent=1))
    return f"embedded capture: sequences {', '.join(SEQUENCES)}"


def copy_package(name: str, folder: Path) -> str:
    """Copy an installed package with its licence."""
    found = distribution(name)
    for file in found.files or ():
        path = Path(str(found.locate_file(file)))
        if ".." not in file.parts and "__pycache__" not in file.parts and path.is_file():
            target = folder / "site" / file
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(path, target)
    return f"site: {name} {found.version}"


def unpack_gsplat(archive: Path | None, folder: Path) -> str:
    """Unpack gsplat's sources, which compile at its first image."""
    with tempfile.TemporaryDirectory() as temporary:
        if archive is None:
            command = [
                sys.executable,
                "-m",
                "pip",
                "download",
                "--quiet",
                "--no-deps",
                "--no-build-isolation",
            ]
            command += ["--no-binary", ":all:", GSPLAT, "--dest", temporary]
            # Else its metadata alone wants nvcc.
            environment = os.environ | {"BUILD_NO_CUDA": "1"}
            done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
            archives = list(Path(temporary).glob("*.tar.gz"))
            if done.returncode or not archives:
                reason = (done.stderr.strip().splitlines() or ["pip brought no archive"])[-1]
                return f"gsplat: left out, pip could not download {GSPLAT} ({reason})"
            archive = archives[0]
        with tarfile.open(archive) as opened:
            opened.extractall(temporary, filter="data")
        (source,) = Path(temporary).glob("gsplat-*/gsplat")
        shutil.copytree(source, folder / "site/gsplat")
        for license_file in source.parent.glob("LICENSE*"):
            shutil.copy(license_file, folder / "site/gsplat")
    return f"site: gsplat, sources of {archive.name}"


def compile_kernels(folder: Path, architecture: int) -> str:
    """Compile Warp's kernels to PTX, which needs neither a GPU nor its driver."""
    if importlib.util.find_spec("warp") is None:
        return "Warp's kernels: left out, warp-lang is not installed here: pip install 'dsar-avatar[gpu]'"
    import warp as wp

    for name in KERNELS:
        module = importlib.import_module(f"dsar.raster.warp_backend.kernels_{name}")
        wp.compile_aot_module(
            module, arch=architecture, module_dir=str(folder / "kernels" / name), use_ptx=True
        )
    return f"kernels: Warp's as PTX for sm_{architecture}; the machine needs warp-lang {wp.config.version}"


if __name__ == "__main__":
    main()
