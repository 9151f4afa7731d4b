"""Bytes of a serial line cut into lines, with an end to those that have none."""

MAX_LINE = 512


class LineSplitter:
    """Bytes in as they come, whole lines out.

    Attributes:
        n_too_long: lines longer than 512 bytes, which are left out.
    """

    def __init__(self) -> None:
        self.n_too_long = 0
        self._rest = b""
        self._is_cut = False

    def feed(self, data: bytes) -> list[bytes]:
        """Take bytes and give the lines that they complete, without their ends; empty ones are left out."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        if lines and self._is_cut:
            del lines[0]
            self._is_cut = False
        if len(self._rest) > MAX_LINE:
            self.n_too_long += not self._is_cut
            self._is_cut = True
        if self._is_cut:
            self._rest = b""
        n_lines = len(lines)
        lines = [line for line in lines if len(line) <= MAX_LINE]
        self.n_too_long += n_lines - len(lines)
        return [line.strip() for line in lines if line.strip()]

    def clear(self) -> None:
        """Forget an unfinished line."""
        self._rest = b""
        self._is_cut = False
