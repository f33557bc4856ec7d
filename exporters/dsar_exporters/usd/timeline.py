"""Where values over time go: into one layer, or into one value clip a frame.

Values that never change are written once. Imports pxr: only the writers of an asset import this module.
"""

# pxr is compiled and carries no type stubs.
# pyright: reportAttributeAccessIssue=false

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Sdf, Usd, Vt

from dsar_exporters.usd.names import clips_manifest

_ELEMENTS_IN_MEMORY = 4_000_000
"""A binary layer keeps what it is given until it is saved, some 12 bytes an element of its arrays; each time
it is saved, it grows by its table of all samples so far."""


class Timeline(ABC):
    """Receives the values of attributes, frame after frame."""

    def hold(self, attribute: Usd.Attribute, value: Any) -> None:
        """Give an attribute the value that it has at all times, until it is released."""
        attribute.Set(value, Usd.TimeCode.Default())

    @abstractmethod
    def release(self, attribute: Usd.Attribute, value: Any, frames: Sequence[int]) -> None:
        """Say that a held attribute, which has had one value over these frames, is going to change."""

    @abstractmethod
    def sample(self, attribute: Usd.Attribute, frame: int, value: Any) -> None:
        """Give an attribute a value at a frame."""

    @abstractmethod
    def end_frame(self, frame: int) -> None:
        """Put a frame, now complete, out of memory."""


class LayerTimeline(Timeline):
    """Time samples in the layer that also holds the prims."""

    def __init__(self, layer: Sdf.Layer) -> None:
        self._layer = layer
        self._elements = 0

    def release(self, attribute: Usd.Attribute, value: Any, frames: Sequence[int]) -> None:
        """Turn the held value into samples at the first and the last frame that had it."""
        attribute.ClearDefault()
        for frame in {frames[0], frames[-1]}:
            self.sample(attribute, frame, value)

    def sample(self, attribute: Usd.Attribute, frame: int, value: Any) -> None:
        """Write a time sample."""
        self._elements += len(value)
        self._layer.SetTimeSample(attribute.GetPath(), frame, value)

    def end_frame(self, frame: int) -> None:
        """Save when enough has come together."""
        if self._elements > _ELEMENTS_IN_MEMORY:
            self._layer.Save()
            self._elements = 0


class ClipTimeline(Timeline):
    """Time samples in one layer a frame, bound to prims as value clips."""

    def __init__(self, folder: Path, name: str) -> None:
        self.folder = folder
        """Holds the clips and their manifest."""
        self._name = name
        self._clip: Sdf.Layer | None = None
        self._manifest = Sdf.Layer.CreateNew(str(clips_manifest(folder)))
        self._paths: list[str] = []
        self._frames: list[int] = []

    def release(self, attribute: Usd.Attribute, value: Any, frames: Sequence[int]) -> None:
        """Make the held value what clips without a sample of it say; they are closed already."""
        attribute.ClearDefault()
        _spec(self._manifest, attribute).default = value

    def sample(self, attribute: Usd.Attribute, frame: int, value: Any) -> None:
        """Write a time sample into the frame's clip."""
        clip = self._clip or self._open(frame)
        if not self._manifest.GetAttributeAtPath(attribute.GetPath()):
            _spec(self._manifest, attribute)
        _spec(clip, attribute)
        clip.SetTimeSample(attribute.GetPath(), frame, value)

    def end_frame(self, frame: int) -> None:
        """Close the frame's clip."""
        if self._clip is not None:
            self._clip.Save()
            self._clip = None

    def _open(self, frame: int) -> Sdf.Layer:
        """Return a new clip for a frame."""
        path = self.folder / f"{self._name}.{frame:04d}.usdc"
        self._clip = Sdf.Layer.CreateNew(str(path))
        self._paths.append(path.name)
        self._frames.append(frame)
        return self._clip

    def bind(self, layer: Sdf.Layer, prims: Sequence[str]) -> None:
        """Save the manifest and let prims take their values from the clips.

        Args:
            layer: Holds the prims and lies beside the clips' folder. No stage should have it open, which
                would open every clip.
            prims: Their paths, the same in the clips.
        """
        self._manifest.Save()
        relative = f"./{self.folder.name}"
        frames = np.array(self._frames, float)
        clips = {
            "assetPaths": Sdf.AssetPathArray([Sdf.AssetPath(f"{relative}/{name}") for name in self._paths]),
            "active": Vt.Vec2dArray.FromNumpy(np.stack([frames, np.arange(len(frames))], -1)),
            "times": Vt.Vec2dArray.FromNumpy(np.stack([frames, frames], -1)),
            "manifestAssetPath": Sdf.AssetPath(f"{relative}/{clips_manifest(self.folder).name}"),
        }
        for prim in prims:
            layer.GetPrimAtPath(prim).SetInfo("clips", {"default": {**clips, "primPath": prim}})


class SharedValue:
    """One value of several attributes: written once while it stays, over time once it changes."""

    def __init__(self, timeline: Timeline, first_frame: int, *attributes: Usd.Attribute) -> None:
        self._timeline, self._attributes = timeline, attributes
        self._first_frame = self._last_frame = first_frame
        self._value: np.ndarray | None = None
        self._changes = False

    def write(self, frame: int, value: np.ndarray, array: Any) -> None:
        """Write the value of a frame; `array` is the Vt type that holds it."""
        if self._value is None:
            constant = array.FromNumpy(value)
            for attribute in self._attributes:
                self._timeline.hold(attribute, constant)
        elif not self._changes and not np.array_equal(value, self._value):
            self._changes = True
            constant = array.FromNumpy(self._value)
            for attribute in self._attributes:
                self._timeline.release(attribute, constant, [self._first_frame, self._last_frame])
        if self._changes:
            sample = array.FromNumpy(value)
            for attribute in self._attributes:
                self._timeline.sample(attribute, frame, sample)
        else:
            self._value = value
        self._last_frame = frame


def _spec(layer: Sdf.Layer, attribute: Usd.Attribute) -> Sdf.AttributeSpec:
    """Return a layer's own declaration of an attribute, made if missing."""
    path = attribute.GetPath()
    spec = layer.GetAttributeAtPath(path)
    if spec is None:
        Sdf.JustCreatePrimAttributeInLayer(
            layer, path, attribute.GetTypeName(), attribute.GetVariability(), attribute.IsCustom()
        )
        spec = layer.GetAttributeAtPath(path)
    return spec
