"""What workers wrote for themselves, divided among another number of them.

Rollouts keep their order: those of the first worker come first. A run's rollouts are so the same batch for
any number of workers that divides it.
"""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from dsar.training.registered_maps import divide_sequences

_CURSORS = "cursors."


def take_rollouts(parts: Sequence[Callable[[], Mapping[str, Tensor]]], chosen: range) -> dict[str, Tensor]:
    """Return some of the rollouts of all workers, as one worker keeps its own.

    Args:
        parts: Reads what each worker wrote: the same number of rollouts each, the first axis of all tensors.
        chosen: Their numbers over all workers.

    Raises:
        ValueError: there are fewer.
    """
    first = parts[0]()
    count = len(first["fresh"])
    if chosen.stop > count * len(parts):
        raise ValueError(f"{count * len(parts)} rollouts are there, {chosen.stop} were expected")
    rows: defaultdict[str, list[Tensor]] = defaultdict(list)
    for number in range(chosen.start // count, -(-chosen.stop // count)):
        offset = number * count
        here = slice(max(chosen.start - offset, 0), min(chosen.stop - offset, count))
        for name, values in (parts[number]() if number else first).items():
            if not name.startswith(_CURSORS):
                rows[name].append(values[here])
                continue
            # Index of the rollout, and where it stands.
            kept = values[(values[:, 0] >= here.start) & (values[:, 0] < here.stop)].clone()
            kept[:, 0] += offset - chosen.start
            if len(kept):
                rows[name].append(kept)
    return {name: torch.cat(values) for name, values in rows.items()}


def merge_registration(parts: Sequence[Mapping[str, Tensor]]) -> dict[str, Tensor]:
    """Return the registered maps of all workers: of each sequence what who is furthest with it has.

    Args:
        parts: What each worker wrote; offsets of the still frames are the same in all.
    """
    merged = dict(parts[0])
    names = [name.removeprefix("fitted.") for name in merged if name.startswith("fitted.")]
    for name in names:
        furthest = max(parts, key=lambda part: int(part[f"fitted.{name}"]))
        merged |= {key: furthest[key] for key in (f"fitted.{name}", f"offsets.{name}")}
    if "complete" not in merged:
        # Older files have the frames that the busiest worker fitted instead.
        clips = {name: range(len(merged[f"offsets.{name}"])) for name in names}
        shares = divide_sequences(clips, len(parts))
        longest = max(sum(len(clips[name]) for name in share) for share in shares)
        merged["complete"] = merged.pop("count") >= longest
    return merged
