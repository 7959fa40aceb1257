"""Decodes what is compressed in a process of its own, with limits of memory and time: the decoders are native code.

Run as a script, without the rest of jvr. Standard input: tasks, each one line of JSON (`kind`, `bytes` of the largest part and what else
the kind needs, `seconds`), then its codestreams. Standard output: the numbers of each task, in C order.
"""

import json
import os
import sys
from typing import Any

# What a decoder may take beside the interpreter: JPEG 2000 works on 32-bit coefficients and their copies. Several threads of Zarr
# have a chunk each, packed and unpacked, and an arena of the allocator.
BASE, PER_BYTE = {"streams": 1 << 26, "zarr": 1 << 30, "tiff": 1 << 28}, {"streams": 24, "zarr": 4, "tiff": 4}


def main() -> None:
    """Does the tasks of standard input; ends with a message on standard error and status 1 where it cannot."""
    while line := sys.stdin.buffer.readline():
        task = json.loads(line)
        {"streams": _streams, "zarr": _zarr, "tiff": _tiff}[task["kind"]](task)
        sys.stdout.buffer.flush()


def _streams(task: dict) -> None:
    """JPEG, JPEG-LS and JPEG 2000: `frames` with `codec`, `bytes`, `rows`, `columns` and `itemsize` of each."""
    import imagecodecs
    import numpy as np

    decoders = {name: getattr(imagecodecs, f"{name}_decode") for name in {frame["codec"] for frame in task["frames"]}}
    _limit(task)
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


def _zarr(task: dict) -> None:
    """Voxels of an array: `store`, a folder or ZIP, `array`, its path there, `index` with `None` for a whole axis, `shape`, `dtype`."""
    import numpy as np
    import zarr
    from numcodecs.blosc import Blosc
    from zarr.storage import ZipStore

    decode = Blosc.decode
    Blosc.decode = lambda self, data, out=None: decode(self, _whole(data), out)

    store = task["store"] if os.path.isdir(task["store"]) else ZipStore(task["store"], mode="r")
    _limit(task)
    try:
        node: Any = zarr.open(store, mode="r", path=task["array"])
        values = np.asarray(node[tuple(slice(None) if one is None else one for one in task["index"])])
    except (Exception, MemoryError) as error:
        sys.exit(f"{type(error).__name__}: {error}")
    if list(values.shape) != task["shape"]:
        sys.exit(f"the chunks are of shape {values.shape}, the array of {task['shape']}")
    sys.stdout.buffer.write(np.ascontiguousarray(values, task["dtype"]).view("u1").data)


def _tiff(task: dict) -> None:
    """All pages of an image: `file`, and `series`, its number there."""
    import logging

    import numpy as np
    import tifffile

    messages, handler = [], logging.Handler(logging.ERROR)
    handler.emit = lambda record: messages.append(record.getMessage())
    logging.getLogger("tifffile").handlers = [handler]
    _limit(task)
    try:
        with tifffile.TiffFile(task["file"]) as file:
            values = file.series[task["series"]].asarray(maxworkers=1)
    except (Exception, MemoryError) as error:
        sys.exit(f"{type(error).__name__}: {error}")
    # A damaged page is logged, and read as if it were black.
    if damage := [message for message in messages if "GDAL_NODATA" not in message]:
        sys.exit(damage[0])
    if values.nbytes != task["bytes"]:
        sys.exit(f"its pages hold {values.nbytes:,} bytes, where its header announces {task['bytes']:,}")
    sys.stdout.buffer.write(np.ascontiguousarray(values).view("u1").data)


def _whole(data: Any) -> Any:
    """Blosc reads what its chunk announces, beyond the end of one that is cut short too."""
    content = memoryview(data).cast("B")
    if len(content) < 16 or int.from_bytes(content[12:16], "little") > len(content):
        raise ValueError("a chunk of Blosc is cut short")
    return data


def _limit(task: dict) -> None:
    try:
        import resource

        with open("/proc/self/statm") as file:
            taken = int(file.read().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        most = taken + BASE[task["kind"]] + PER_BYTE[task["kind"]] * task["bytes"]
        used = sum(resource.getrusage(resource.RUSAGE_SELF)[:2])
        for kind, limit in ((resource.RLIMIT_AS, most), (resource.RLIMIT_CPU, int(used) + task["seconds"])):
            # The hard limit stays for the next task.
            resource.setrlimit(kind, (limit, resource.getrlimit(kind)[1]))
    except (ImportError, OSError, ValueError):
        # Systems without such limits: the caller's time limit remains.
        pass


if __name__ == "__main__":
    main()
