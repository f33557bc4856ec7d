"""The views that an update compares with images: loaded while the network computes, drawn in one call."""

from collections.abc import Iterable, Sequence
from concurrent.futures import Future

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dsar.config import LossConfig
from dsar.devices import send
from dsar.raster import rasterize_views, reduced_dilation
from dsar.training.image_losses import image_losses
from dsar.training.targets import Target, TargetLoader
from dsar.types import Gaussians


class ViewBatch:
    """Views of the frames of an update, each on a background drawn by chance."""

    def __init__(self, loader: TargetLoader, rng: np.random.Generator, reduction: int, views: int) -> None:
        """Begin without a frame.

        Args:
            loader: Loads the images.
            rng: Chooses cameras and backgrounds.
            reduction: Factor by which images are reduced.
            views: Cameras of a frame, as many as there are at most.
        """
        self._loader, self._rng = loader, rng
        self._reduction, self._views = reduction, views
        self._targets: list[list[Future[Target]]] = []
        self._backgrounds: list[Float[np.ndarray, "v 3"]] = []

    def __len__(self) -> int:
        """Return the number of views."""
        return sum(map(len, self._targets))

    def request(self, frames: Iterable[tuple[str, int]]) -> int:
        """Begin to load views of frames of named sequences; return how many."""
        before = len(self)
        for sequence, frame in frames:
            self._targets.append(
                self._loader.request(self._rng, sequence, frame, self._reduction, self._views)
            )
        added = len(self) - before
        self._backgrounds.append(self._rng.random((added, 3), np.float32))
        return added

    def compare(
        self, gaussians: Sequence[Gaussians], config: LossConfig, lpips: torch.nn.Module | None
    ) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
        """Return the summed loss and squared error of all views, of the Gaussians of each frame in turn."""
        targets = [[future.result() for future in views] for views in self._targets]
        flat = [target for views in targets for target in views]
        if not flat:
            device = gaussians[0].means.device if gaussians else None
            return torch.zeros((), device=device), torch.zeros((), device=device)
        backgrounds = send(torch.from_numpy(np.concatenate(self._backgrounds)), gaussians[0].means.device)
        drawn = rasterize_views(
            gaussians,
            [[target.camera for target in views] for views in targets],
            backgrounds=backgrounds,
            dilation=reduced_dilation(self._reduction),
        )
        images = [image for views in drawn for image in views]
        losses, errors = image_losses(images, flat, backgrounds, config, lpips)
        return losses.sum(), errors.sum()
