"""The size that a JPEG announces, from its markers, before any decoder sees it."""

FRAMES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
NO_LENGTH = {0x01, *range(0xD0, 0xD9)}


def jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Width and height in the first frame header; `None` where there is none, or more than one."""
    at, found = 2, None
    if data[:2] != b"\xff\xd8":
        return None
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF or marker in NO_LENGTH:
            at += 1 if marker == 0xFF else 2
            continue
        if marker in FRAMES:
            if found is not None or at + 9 > len(data):
                return None
            found = int.from_bytes(data[at + 7 : at + 9], "big"), int.from_bytes(data[at + 5 : at + 7], "big")
        if marker == 0xDA:
            break
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return found
