"""The rasteriser benchmark's tables in words."""


def describe_size(row: dict) -> str:
    """Return a scene's size in words."""
    return f"{row['gaussians']} at {row['width']} x {row['height']}"


def describe_row(row: dict) -> str:
    """Return one line of the table of times."""
    threads = f"{row['threads']} thread{'s' if row['threads'] > 1 else ' '}"
    case = f"{row['rasteriser']:22} {describe_size(row):20} {threads:9} {row['pass'].replace('_', ' + '):18}"
    if row["skipped"]:
        return f"{case} skipped: {row['skipped']}"
    spread = f"{row['low_ms']:.2f} - {row['high_ms']:.2f}"
    return f"{case} {row['median_ms']:9.2f} ms  ({spread}, {row['runs']} runs)"


def describe_rival(entry: dict) -> str:
    """Return one line about a rival before it is timed."""
    name = f"{entry['name']} {entry['version'] or ''}".strip()
    image = "" if entry["psnr_db"] is None else f" [image {entry['psnr_db']:.1f} dB from ours]"
    return f"{name}: skipped, {entry['skipped']}" if entry["skipped"] else f"{name}{image}: {entry['about']}"


def describe_arithmetic(row: dict) -> str:
    """Return one line of the table of arithmetic."""
    return (
        f"cpu forward, {describe_size(row)}, {row['threads']} thread(s): "
        f"{1e-6 * row['fragments_per_s']:.0f} M fragments/s = {row['gflops']:.1f} GFLOP/s, "
        f"{100 * row['share_of_peak']:.1f} % of the peak "
        f"({100 * row['share_of_peak_blended']:.1f} % with the fragments that are blended only)"
    )


def describe_ratio(row: dict) -> str:
    """Return one ratio in words."""
    return (
        f"cpu is {row['ratio']:.0f}x as fast as {row['rival']}, {row['pass'].replace('_', ' + ')} of "
        f"{row['gaussians']} at {row['width']} x {row['height']}, {row['threads']} threads"
    )


def describe_stages(row: dict) -> str:
    """Return where the time of one scene goes."""
    times = ", ".join(f"{name.removesuffix('_part')} {ms:.2f}" for name, ms in row["median_ms"].items())
    shares = " and ".join(f"{100 * share:.0f} %" for share in row["share_of_peak"].values())
    return (
        f"cpu stages, {describe_size(row)}, {row['threads']} thread(s), ms: {times}; blending forward and "
        f"backward at {shares} of the peak ({1e-6 * row['lanes']:.2f} M lanes)"
    )
