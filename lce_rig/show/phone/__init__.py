"""A page that shows a live collection to the person who holds the board, on a phone or a big screen."""

from lce_rig.show.phone.address import DEFAULT_PORT, LOOPBACK, parse_address
from lce_rig.show.phone.preview import Preview

__all__ = ["DEFAULT_PORT", "LOOPBACK", "Preview", "parse_address"]
