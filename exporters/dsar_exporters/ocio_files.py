"""What an OCIO configuration depends on besides its own text: files it names, variables it reads.

OpenImageIO says neither. A name is written as `src: NAME` of a FileTransform and looked for in the folders of
`search_path`, beside the configuration; both may hold `$VARIABLE`s, which the environment sets.
"""

import hashlib
import os
import re
from collections.abc import Iterator
from pathlib import Path

_SOURCE = re.compile(r"\bsrc:\s*(?:\"([^\"]*)\"|'([^']*)'|([^,}\n#]+))")
_SEARCH_PATH = re.compile(r"^search_path:[ \t]*(\S.*)?\n((?:[ \t]*-[ \t]+.*\n)*)", re.MULTILINE)
_VARIABLE = re.compile(r"\$\{(\w+)\}|\$(\w+)|%(\w+)%")
_DEFAULT = re.compile(r"^[ \t]+(\w+):[ \t]*(.*)$", re.MULTILINE)
_ENVIRONMENT = re.compile(r"^environment:[ \t]*(?:\{(.*)\}|\n((?:[ \t]+.*\n)*))", re.MULTILINE)


def hash_config(config: str) -> str:
    """Return a hash of all that a configuration says: its text, its look-up tables, variables in their names.

    A built-in configuration is its name.

    Raises:
        ExportError: it cannot be read.
    """
    if config.startswith("ocio://"):
        return config
    path = Path(config)
    content = path.read_bytes()
    digest = hashlib.sha256(content)
    text = content.decode(errors="replace")
    for name in sorted(set(_sources(text))):
        for variable, value in sorted(_variables(name, text).items()):
            digest.update(f"\0{variable}={value}".encode())
        file = _find_file(_expanded(name, text), path.parent, text)
        digest.update(
            f"\0{name}\0".encode() + (b"" if file is None else hashlib.sha256(file.read_bytes()).digest())
        )
    return digest.hexdigest()


def _sources(text: str) -> Iterator[str]:
    for match in _SOURCE.finditer(text):
        yield next(part for part in match.groups() if part is not None).strip()


def _find_file(name: str, folder: Path, text: str) -> Path | None:
    """Return the file of a name, None where there is none: then nothing can be converted through it."""
    candidates = (folder / subfolder / name for subfolder in ("", *_search_path(text)))
    return next((file for file in candidates if file.is_file()), None)


def _search_path(text: str) -> Iterator[str]:
    for match in _SEARCH_PATH.finditer(text):
        folders = [match[1] or "", *(line.strip().lstrip("-") for line in (match[2] or "").splitlines())]
        for folder in ":".join(folders).split(":"):
            yield _expanded(folder.strip().strip("\"'"), text)


def _expanded(name: str, text: str) -> str:
    values = _variables(name, text)
    return _VARIABLE.sub(lambda match: values[next(filter(None, match.groups()))] or match[0], name)


def _variables(name: str, text: str) -> dict[str, str | None]:
    """Return the variables in a name: as the environment has them, else by the configuration's defaults."""
    names = [next(filter(None, match.groups())) for match in _VARIABLE.finditer(name)]
    defaults = dict(_DEFAULT.findall(_environment(text)))
    return {variable: os.environ.get(variable, defaults.get(variable)) for variable in names}


def _environment(text: str) -> str:
    """Return the configuration's `environment`, a line a variable."""
    match = _ENVIRONMENT.search(text)
    if match is None:
        return ""
    return match[2] or "".join(f" {part.strip()}\n" for part in (match[1] or "").split(","))
