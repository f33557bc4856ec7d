"""Direct attention to the features of previous frames, in place of the state stream's hidden states."""

from torch import Tensor

from dsar.network.memory import MemoryBank


class FeatureBank(MemoryBank):
    """A memory bank of deepest features as they were before any attention."""

    def first_entry(self, aggregate: Tensor, features: Tensor) -> Tensor:
        """Return the features: those that the first step looks at are its own."""
        return features

    def entry(self, hidden: Tensor, features: Tensor) -> Tensor:
        """Return the features."""
        return features
