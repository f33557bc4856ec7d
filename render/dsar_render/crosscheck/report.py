"""The cross-check as one self-contained page."""

import base64
import io
from pathlib import Path

import numpy as np
from jinja2 import Environment, StrictUndefined
from PIL import Image

from dsar.atomic_files import atomic_write
from dsar.geometry.camera_faults import PROJECTION_FAULTS
from dsar_render.crosscheck.oracle import STEPS
from dsar_render.crosscheck.verdict import Verdict


def write_crosscheck_report(verdict: Verdict, path: Path) -> Path:
    """Write what was found, with images side by side, and return the page's path."""
    engine = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    source = Path(__file__).with_name("report.html.jinja").read_text(encoding="utf-8")
    facts = {
        "verdict": verdict,
        "descriptions": {fault.name: fault.description for fault in PROJECTION_FAULTS}
        | {"unknown": "none of the usual mistakes"},
        "steps": STEPS,
        "pictures": {name: [_embedded(image) for image in row] for name, row in verdict.pictures.items()},
    }
    with atomic_write(path) as draft:
        draft.write_text(engine.from_string(source).render(facts), encoding="utf-8")
    return path


def _embedded(image: np.ndarray) -> str:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="PNG")
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()
