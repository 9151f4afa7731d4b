"""The process in which a profile's own network runs: little memory, no files, and it ends with its parent.

It receives requests as lines of JSON on stdin and answers with lines on stdout; arrays lie in memory that
both share. `model_process` is the other end.
"""

import json
import os
import queue
import resource
import sys
import threading
from collections.abc import Sequence
from typing import Any, BinaryIO

import numpy as np

from lce_rig.detect.events.reconstruct.onnx_session import LocalSession, NetworkError
from lce_rig.detect.events.reconstruct.voxels import FloatArray

MAX_BYTES = 2 << 30
"""What a network may take for itself: E2VID at 1280 x 720 needs 1 GB."""


def main() -> None:
    """Answer until stdin ends."""
    requests: queue.SimpleQueue[tuple[dict[str, Any], bytes]] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(sys.stdin.buffer, requests), daemon=True).start()
    memory_fd = int(sys.argv[1])
    # onnxruntime writes to stdout what it thinks of a file.
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    session: LocalSession | None = None
    while True:
        request, content = requests.get()
        try:
            if request["do"] == "load":
                session = None  # The former network's memory first.
                session = _load(content, request["n_threads"])
                answer: dict[str, Any] = {
                    "inputs": [(port.name, port.shape) for port in session.inputs],
                    "outputs": [(port.name, port.shape) for port in session.outputs],
                }
            else:
                assert session is not None
                _step(session, memory_fd, request)
                answer = {}
        except ImportError as error:
            answer = {"missing": error.name or "onnxruntime"}
        except (NetworkError, MemoryError) as error:
            answer = {"error": str(error) or "out of memory"}
        answers.write(json.dumps(answer) + "\n")
        answers.flush()


def _listen(stdin: BinaryIO, requests: "queue.SimpleQueue[tuple[dict[str, Any], bytes]]") -> None:
    """Take requests; the end of stdin means the end of the parent, at any time."""
    while line := stdin.readline():
        request = json.loads(line)
        requests.put((request, stdin.read(request.get("n_bytes", 0))))
    os._exit(0)


def _load(content: bytes, n_threads: int) -> LocalSession:
    import onnxruntime  # noqa: F401  before nothing can be opened any more

    resource.setrlimit(resource.RLIMIT_DATA, (MAX_BYTES, MAX_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    # A network can name other files as its weights: whichever they are, they cannot be opened.
    resource.setrlimit(resource.RLIMIT_NOFILE, (0, 0))
    return LocalSession(content, n_threads)


def _step(session: LocalSession, memory_fd: int, request: dict[str, Any]) -> None:
    """Run once: inputs lie at the beginning of the shared memory, outputs follow them."""
    feeds = [np.empty(shape, np.float32) for shape in request["inputs"]]
    read_arrays(memory_fd, feeds, 0)
    found = session.run(feeds, [tuple(shape) for shape in request["outputs"]])
    write_arrays(memory_fd, found, sum(feed.nbytes for feed in feeds))


def write_arrays(memory_fd: int, arrays: Sequence[FloatArray], offset: int) -> None:
    """Write arrays one after the other into shared memory, from an offset on."""
    # Mapped memory would take a descriptor, and here there are none.
    for array in arrays:
        offset += os.pwrite(memory_fd, np.ascontiguousarray(array).data, offset)


def read_arrays(memory_fd: int, arrays: Sequence[FloatArray], offset: int) -> None:
    """Fill arrays from shared memory, as `write_arrays` left it."""
    for array in arrays:
        offset += os.preadv(memory_fd, [array.data], offset)


if __name__ == "__main__":
    main()
