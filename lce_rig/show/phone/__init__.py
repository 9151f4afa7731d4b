"""A page that shows a live collection to the person with the board, on a phone or a big screen."""

#: Default address of the page: this computer alone.
LOOPBACK, DEFAULT_PORT = "127.0.0.1", 8765
