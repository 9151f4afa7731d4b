"""A page that shows a live collection to the person who holds the board, on a phone or a big screen."""

from lce_rig.page.address import DEFAULT_PORT, LOOPBACK, parse_address
from lce_rig.page.preview import Preview

__all__ = ["DEFAULT_PORT", "LOOPBACK", "Preview", "parse_address"]
