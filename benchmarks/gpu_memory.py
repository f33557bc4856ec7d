"""The most memory of a GPU that something needed."""

import torch


def forget_peak() -> None:
    """Begin to watch anew."""
    if torch.cuda.is_initialized():
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()


def read_peak() -> int | None:
    """Return the bytes that tensors held at most, those before included; None without a GPU."""
    if not torch.cuda.is_initialized():
        return None
    torch.cuda.synchronize()
    return torch.cuda.max_memory_allocated()
