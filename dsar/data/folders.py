"""What a folder really holds: found whatever the case of its names, without the litter of file managers."""

import unicodedata
import zipfile
from pathlib import Path, PurePath, PurePosixPath

from dsar.errors import CaptureError

_LITTER = {"thumbs.db", "desktop.ini", "__macosx", "$recycle.bin", "system volume information", "@eadir"}
_IMAGES = {".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp"}


def is_litter(path: PurePath) -> bool:
    """Return whether a path, or a folder of it, is hidden or left there by a file manager."""
    return any(part.startswith(".") or part.lower() in _LITTER for part in path.parts)


def list_folder(folder: Path) -> list[Path]:
    """Return a folder's files and folders in order, without litter; none where there is no such folder."""
    entries = folder.iterdir() if folder.is_dir() else ()
    return sorted(path for path in entries if not is_litter(PurePath(path.name)))


def list_images(folder: Path) -> list[Path]:
    """Return a folder's images in order."""
    return [path for path in list_folder(folder) if path.suffix.lower() in _IMAGES]


def list_members(archive: zipfile.ZipFile) -> list[str]:
    """Return the files of an archive, without litter."""
    names = [name for name in archive.namelist() if not name.endswith("/")]
    return [name for name in names if not is_litter(PurePosixPath(name))]


def inside(where: str, root: Path, name: str) -> Path:
    """Return the path of a file that another file names, which must lie in the same folder.

    Raises:
        CaptureError: it lies elsewhere.
    """
    path = PurePosixPath(name.replace("\\", "/"))
    if not path.parts or path.is_absolute() or ".." in path.parts or ":" in path.parts[0]:
        raise CaptureError(f"{where}: expected a path inside {root}, found {name!r}; put the file there")
    return Finder(root).find(root / path) or root / path


def check_name(where: str, name: str, error: type[Exception] = CaptureError) -> str:
    """Return a name that is to be part of paths, or raise `error` where it would leave its folder."""
    wrong = not name.strip(" .") or name.startswith(".") or name != name.strip()
    if wrong or any(sign in '/\\:*?"<>|' or not sign.isprintable() for sign in name):
        raise error(
            f"{where}: expected a name that can be a file's, found {name!r}; use letters, digits, _ and -"
        )
    return name


class Finder:
    """Finds files below a folder whatever the case of their names, and images whatever their suffix.

    A folder is listed once: what comes later is not seen.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self._lists: dict[Path, dict[tuple[str, str], list[Path]]] = {}

    def find(self, path: Path) -> Path | None:
        """Return the file or folder that is meant by a path below the root; None where there is none."""
        if path == self.root:
            return path
        folder = self.find(path.parent)
        if folder is None:
            return None
        if folder not in self._lists:
            listed = self._lists.setdefault(folder, {})
            for each in list_folder(folder):
                listed.setdefault(_key(each), []).append(each)
        meant = self._lists[folder].get(_key(path), [])
        return min(meant, key=lambda each: (each.name != path.name, _unlike(each, path), each), default=None)


def find_file(folder: Path, name: str) -> Path:
    """Return the file of a name, whatever its case; where there is none, where it should be."""
    return Finder(folder).find(folder / name) or folder / name


def _key(path: Path) -> tuple[str, str]:
    suffix = path.suffix.lower()
    stem = unicodedata.normalize("NFC", path.stem).casefold()
    return stem, "image" if suffix in _IMAGES else suffix


def _unlike(path: Path, wanted: Path) -> bool:
    return path.suffix.lower() != wanted.suffix.lower()
