"""Progress reports."""

from collections.abc import Callable

Progress = Callable[[int, int], None]
"""Called with (done, total). If it has a method `begin`, that is called with the name of each step."""


def silent(done: int, total: int) -> None:
    """Report no progress."""


def begin(progress: Progress, step: str) -> None:
    """Name the next step, to which the following (done, total) belong."""
    show_step = getattr(progress, "begin", None)
    if show_step is not None:
        show_step(step)
