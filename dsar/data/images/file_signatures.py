"""What a file is that claims to be an image and is none that we read."""

from pathlib import Path

_HEAD = 512
_TIFF = (
    "a TIFF of a kind that Pillow does not read, such as floating-point RGB or a raw photograph: save it "
    "with 8 bits, as PNG or JPEG"
)
_SIGNS = (
    (b"version https://git-lfs", "a Git LFS pointer: fetch the real file with `git lfs pull`"),
    (b"PK\x03\x04", "a zip archive: unpack it"),
    (b"\x1f\x8b", "a gzip archive: unpack it"),
    (b"%PDF", "a PDF: save its picture as PNG"),
    (b"\x76\x2f\x31\x01", "an OpenEXR file: convert it to 8-bit sRGB"),
    (b"\xff\x0a", "a JPEG XL: convert it to PNG or JPEG"),
    (b"\x00\x00\x00\x0cJXL ", "a JPEG XL: convert it to PNG or JPEG"),
    (b"8BPS", "a Photoshop document of a kind that Pillow does not read: save it as PNG"),
    (b"\x93NUMPY", "a NumPy array: save it as PNG"),
    (b"RIFF", "a RIFF file (AVI or WAV), or a damaged WebP"),
    (b"II*\x00", _TIFF),
    (b"MM\x00*", _TIFF),
    (b"\xff\xd8", "a JPEG whose beginning is damaged: copy it again"),
    (b"\x89PNG", "a PNG whose beginning is damaged: copy it again"),
)  # fmt: skip
_BRANDS = {
    b"heic": "a HEIC photograph", b"heix": "a HEIC photograph", b"mif1": "a HEIF photograph",
    b"hevc": "a HEIC photograph", b"msf1": "a HEIF sequence", b"avif": "an AVIF",
    b"crx ": "a raw photograph (CR3)",
}  # fmt: skip


def describe_file(data: bytes | Path) -> str:
    """Return what a file is, by its first bytes, and what to do with it."""
    head = data[:_HEAD] if isinstance(data, bytes) else _read_head(data)
    if not head:
        return "empty (0 bytes): copy it again"
    if not any(head):
        return "zeros alone, a copy that was cut short: copy it again"
    if head[4:8] == b"ftyp":
        return f"{_BRANDS.get(head[8:12], 'a video (MP4, MOV)')}: convert it to PNG or JPEG"
    description = next((words for sign, words in _SIGNS if head.startswith(sign)), None)
    if description:
        return description
    text = head.lstrip(b"\xef\xbb\xbf \t\r\n").lower()
    if text.startswith((b"<!doctype html", b"<html")):
        return "a web page (HTML), of a download that failed: download it again"
    if all(byte >= 32 or byte in b"\t\r\n" for byte in head):
        return f"text that begins with {head[:40].decode('utf-8', 'replace').split(chr(10))[0]!r}"
    return "no image that we know"


def _read_head(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(_HEAD)
