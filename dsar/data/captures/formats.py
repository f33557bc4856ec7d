"""One door to captures of every format, which are told apart by what they hold."""

from collections.abc import Callable
from pathlib import Path

from dsar.config import EMBEDDED, EMBEDDED_CAPTURES, TrainConfig
from dsar.data.captures.avatarrex import (
    PARAMETERS,
    actorshq_calibration,
    open_actorshq,
    open_avatarrex,
    open_thuman4,
)
from dsar.data.captures.dress4d import is_4d_dress, open_4d_dress
from dsar.data.captures.multiview import MultiViewCapture
from dsar.data.captures.native import RECORD_NAME, open_native
from dsar.data.captures.takes import OpenOptions
from dsar.data.folders import find_file
from dsar.errors import CaptureError

_DATA = Path(__file__).parents[1]
EMBEDDED_CAPTURE = _DATA / EMBEDDED_CAPTURES[EMBEDDED]
"""The first of the simulated captures that come with the package."""


def _open_native(root: Path, options: OpenOptions) -> MultiViewCapture:
    return open_native(root, options.body).with_frames(options.train_frames, options.test_frames)


FORMATS: dict[str, tuple[Callable[[Path], bool], Callable[[Path, OpenOptions], MultiViewCapture]]] = {
    f"our own ({RECORD_NAME})": (
        lambda root: find_file(root, RECORD_NAME).is_file(),
        _open_native,
    ),
    f"AvatarReX (calibration_full.json, {PARAMETERS})": (
        lambda root: find_file(root, "calibration_full.json").is_file(),
        open_avatarrex,
    ),
    f"THuman4.0 (calibration.json, {PARAMETERS})": (
        lambda root: find_file(root, "calibration.json").is_file(),
        open_thuman4,
    ),
    f"ActorsHQ (4x/calibration.csv, {PARAMETERS})": (
        lambda root: actorshq_calibration(root) is not None,
        open_actorshq,
    ),
    "4D-DRESS (Take*/basic_info.pkl, Capture/cameras.pkl)": (is_4d_dress, open_4d_dress),
}
"""What tells a format, and what reads it."""


def open_capture(
    source: str | Path = EMBEDDED,
    *,
    body: str | Path | None = None,
    train_frames: str | None = None,
    test_frames: str | None = None,
) -> MultiViewCapture:
    """Return a capture, checked for completeness.

    Args:
        source: A capture folder in any format of `FORMATS`, `embedded` or `embedded-wool` for those that
            come with the package.
        body: A body-model file instead of the capture's own, or a folder of SMPLX_<GENDER> files. Without
            one, captures in foreign formats take $DSAR_BODY.
        train_frames: Frames that train, such as 0-239: of a capture's single take, or of each training one.
        test_frames: Frames that test, likewise.

    Raises:
        CaptureError: The folder is no capture, or something in it is missing or malformed.
        MotionError: Its motion is.
        BodyError: The body file is.
    """
    embedded = EMBEDDED_CAPTURES.get(str(source))
    root = _DATA / embedded if embedded else Path(source).expanduser().resolve()
    if not root.is_dir():
        found = "a file" if root.exists() else "nothing"
        names = " or ".join(f"`{name}`" for name in EMBEDDED_CAPTURES)
        raise CaptureError(f"capture {root}: expected the folder of a capture, {names}, found {found}")
    options = OpenOptions(None if body is None else Path(body), train_frames, test_frames)
    for is_format, open_format in FORMATS.values():
        if is_format(root):
            return open_format(root, options)
    raise CaptureError(
        f"capture {root}: no format that we know: {'; '.join(FORMATS)}; give the folder that holds these "
        "files (docs/capture-format.md)"
    )


def capture_of(config: TrainConfig) -> MultiViewCapture:
    """Return the capture of a run, all cameras.

    Raises:
        DsarError: as `open_capture` does.
    """
    return open_capture(
        config.capture, body=config.body, train_frames=config.train_frames, test_frames=config.test_frames
    )
