"""Colour profiles made here, whose effect is known: RGB of other primaries, and printing inks."""

import struct

import numpy as np
from PIL import ImageCms

P3 = np.array([[0.51512, 0.24120, -0.00105], [0.29198, 0.69225, 0.04189], [0.15710, 0.06657, 0.78407]])
"""XYZ (D50) of Display P3's red, green and blue."""
SRGB = np.array([[0.43607, 0.22249, 0.01392], [0.38515, 0.71687, 0.09708], [0.14307, 0.06061, 0.71410]])
"""And of sRGB's."""


def rgb_profile(primaries=SRGB):
    """Return sRGB's profile with other primaries."""
    data = bytearray(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    for index in range(struct.unpack_from(">I", data, 128)[0]):
        name, start, _ = struct.unpack_from(">4sII", data, 132 + 12 * index)
        if name in (b"rXYZ", b"gXYZ", b"bXYZ"):
            xyz = primaries["rgb".index(chr(name[0]))]
            struct.pack_into(">3i", data, start + 8, *(round(65536 * value) for value in xyz))
    return bytes(data)


def ink_profile(paper):
    """Return a profile of CMYK in which inks c, m, y, k of 0 or 1 give `paper(c, m, y, k)`, CIELAB."""
    corners = [paper(*map(int, f"{index:04b}")) for index in range(16)]
    table = bytes(
        round(value) for L, a, b in corners for value in (L * 255 / 100, a + 128, b + 128)
    )  # fmt: skip
    ramp = bytes(range(256))
    identity = struct.pack(">9i", *(65536 * (row == column) for row in range(3) for column in range(3)))
    tags = {
        b"desc": b"desc\0\0\0\0" + struct.pack(">I", 5) + b"inks\0" + bytes(78),
        b"cprt": b"text\0\0\0\0none\0",
        b"wtpt": b"XYZ \0\0\0\0" + struct.pack(">3i", 63190, 65536, 54061),
        b"A2B0": b"mft1\0\0\0\0" + bytes([4, 3, 2, 0]) + identity + 4 * ramp + table + 3 * ramp,
    }
    body, entries, start = b"", b"", 132 + 12 * len(tags)
    for name, content in tags.items():
        content += bytes(-len(content) % 4)
        entries += struct.pack(">4sII", name, start + len(body), len(content))
        body += content
    header = struct.pack(">I4sI4s4s4s", start + len(body), b"lcms", 0x02400000, b"prtr", b"CMYK", b"Lab ")
    header += bytes(12) + b"acsp" + bytes(28) + struct.pack(">3i", 63190, 65536, 54061)
    return header.ljust(128, b"\0") + struct.pack(">I", len(tags)) + entries + body
