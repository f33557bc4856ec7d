"""The GPU benchmark's rows in words, and the ratios that it is run for."""

from gpu_network import OURS
from network import LITERAL


def describe_row(section: str, row: dict) -> str:
    """Return one line about a row of a section."""
    keys = ("preset", "stage", "pass", "scene", "backend", "design", "precision", "start", "at_once")
    words = [f"{key}={row[key]}" if key == "at_once" else str(row[key]) for key in keys if key in row]
    if "width" in row:
        words.append(f"{row['gaussians']} at {row['width']} x {row['height']}, {row.get('views', 1)} views")
    text = f"{section}: {' '.join(words)}"
    if row["skipped"]:
        return f"{text} skipped: {row['skipped']}"
    if "agrees" in row:
        worst = max(row["gradients"].values())
        verdict = "agrees" if row["agrees"] else "DOES NOT AGREE"
        return f"{text} {verdict}: values {max(row['median'].values()):.1e}, gradients {worst:.1e}"
    if "median_ms" in row:
        text += f" {row['median_ms']:.3f} ms ({row['low_ms']:.3f} - {row['high_ms']:.3f}, {row['runs']} runs)"
    for key, unit in (("updates_per_s", "updates/s"), ("frames_per_s", "frames/s")):
        if key in row:
            text += f", {row[key]:.1f} {unit}"
    if row.get("peak_bytes"):
        text += f", {row['peak_bytes'] / 2**30:.2f} GiB"
    if "parts_ms" in row:
        text += "; " + ", ".join(f"{name} {ms:.3f}" for name, ms in row["parts_ms"].items())
    if "kernels" in row:
        text += f"kernels {row['kernels']}"
    if "gpu" in row:
        text += f"{row['gpu']}, {row['architecture']}, CUDA {row['cuda']}"
    return text


def find_ratios(sections: dict[str, dict]) -> list[dict]:
    """Return the figures to quote, the headline last: as many as what was measured allows."""
    rows = {name: [row for row in entry["rows"] if not row["skipped"]] for name, entry in sections.items()}
    ratios = [*_against_gsplat(rows.get("gsplat", [])), *_batched(rows.get("raster", []))]
    ratios += _against_cpu(rows.get("training", []), rows.get("cpu training", []))
    if frames := rows.get("frame"):
        best = max(frames, key=lambda row: row["frames_per_s"])
        what = (
            f"whole frames of {best['gaussians']} at {best['width']} x {best['height']}, {best['precision']}"
        )
        ratios.append({"what": what, "value": best["frames_per_s"], "unit": "a second"})
    return ratios + _against_literal(rows.get("network", []))


def _against_literal(rows: list[dict]) -> list[dict]:
    """Return how many times as fast our fastest variant is as the literal design's with TF32."""
    ratios = []
    for name, preset in (
        ("training", "demo"),
        ("training", "paper"),
        ("rollout", "demo"),
        ("rollout", "paper"),
    ):
        found = [row for row in rows if (row["pass"], row["preset"]) == (name, preset)]
        ours = [row for row in found if row["design"] == OURS]
        # In TF32 as PyTorch's users have it; where it was not measured, the first precision that was.
        literal = [row for row in found if row["design"] == LITERAL and row["start"] == "eager"]
        literal.sort(key=lambda row: row["precision"] != "tf32")
        if ours and literal:
            best = min(ours, key=lambda row: row["median_ms"])
            what = (
                f"{name}, {preset}: ours ({best['precision']}, {best['start']}) against the literal design "
                f"({literal[0]['precision']}, eager)"
            )
            value = literal[0]["median_ms"] / best["median_ms"]
            ratios.append({"what": what, "value": value, "unit": "times as fast"})
    return ratios


def _against_gsplat(rows: list[dict]) -> list[dict]:
    """Return how many times as fast Warp is as gsplat, by case."""
    timed: dict[tuple, dict[str, float]] = {}
    for row in rows:
        if row.get("kind") == "time":
            key = (
                row["pass"],
                row["gaussians"],
                row["width"],
                row["height"],
                row["views"],
                row.get("at_once"),
            )
            timed.setdefault(key, {})[row["backend"]] = row["median_ms"]
    return [
        {
            "what": f"Warp against gsplat, {key[0]}, {key[1]} at {key[2]} x {key[3]}, {key[4]} views, "
            f"at once: {key[5]}",
            "value": times["gsplat"] / times["warp"],
            "unit": "times as fast",
        }
        for key, times in timed.items()
        if len(times) == 2
    ]


def _batched(rows: list[dict]) -> list[dict]:
    """Return how many times as fast views are in one call as one by one."""
    timed: dict[tuple, dict[bool, dict]] = {}
    for row in rows:
        if "at_once" in row:
            timed.setdefault((row["backend"], row["pass"]), {})[row["at_once"]] = row
    return [
        {
            "what": f"{backend}, {name}: {both[True]['views']} views in one call against one by one",
            "value": both[False]["median_ms"] / both[True]["median_ms"],
            "unit": "times as fast",
        }
        for (backend, name), both in timed.items()
        if len(both) == 2
    ]


def _against_cpu(rows: list[dict], cpu: list[dict]) -> list[dict]:
    """Return how many times as fast the demo's updates are as with one thread of this machine's CPU."""
    slow = {row["stage"]: row["median_ms"] for row in cpu}
    return [
        {
            "what": f"demo, {row['stage']}: an update against one thread of the CPU",
            "value": slow[row["stage"]] / row["median_ms"],
            "unit": "times as fast",
        }
        for row in rows
        if row["preset"] == "demo" and row["stage"] in slow
    ]
