"""Decodes JPEG, JPEG-LS and JPEG 2000 in a process of its own, with limits of memory and time: these decoders are native code.

Run as a script, without the rest of jvr. Standard input: one line of JSON (`seconds`, and for each frame `codec`, `bytes`,
`rows`, `columns`, `itemsize`), then the codestreams. Standard output: the pixels of all frames, in native byte order.
"""

import json
import os
import sys

# What a decoder may take beside the interpreter: JPEG 2000 works on 32-bit coefficients and their copies.
BASE, PER_BYTE = 1 << 26, 24


def main() -> None:
    """Decodes all frames of standard input; ends with a message on standard error and status 1 at the first that fails."""
    import imagecodecs
    import numpy as np

    task = json.loads(sys.stdin.buffer.readline())
    decoders = {name: getattr(imagecodecs, f"{name}_decode") for name in {frame["codec"] for frame in task["frames"]}}
    largest = max(frame["rows"] * frame["columns"] * frame["itemsize"] for frame in task["frames"])
    _limit(BASE + PER_BYTE * largest, task["seconds"])
    for k, frame in enumerate(task["frames"]):
        try:
            picture = np.asarray(decoders[frame["codec"]](sys.stdin.buffer.read(frame["bytes"])))
        except (Exception, MemoryError) as error:
            sys.exit(f"picture {k + 1}: {type(error).__name__}: {error}")
        wanted = (frame["rows"], frame["columns"])
        if picture.shape != wanted or picture.dtype.kind not in "iu" or picture.itemsize > frame["itemsize"]:
            sys.exit(f"picture {k + 1}: the header announces {wanted}, the compressed picture is {picture.shape} {picture.dtype}")
        signed = picture.dtype.kind == "i"
        sys.stdout.buffer.write(picture.astype(f"{'i' if signed else 'u'}{frame['itemsize']}").tobytes())


def _limit(extra: int, seconds: int) -> None:
    try:
        import resource

        with open("/proc/self/statm") as file:
            taken = int(file.read().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        resource.setrlimit(resource.RLIMIT_AS, (taken + extra, taken + extra))
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
    except (ImportError, OSError, ValueError):
        # Systems without such limits: the caller's time limit remains.
        pass


if __name__ == "__main__":
    main()
