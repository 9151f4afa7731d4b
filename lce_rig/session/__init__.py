"""Sessions on disk: captures that exist whole or not at all, a journal, a frozen profile and a cache."""

from lce_rig.session.capture import Capture, content_hash
from lce_rig.session.session import Session

__all__ = ["Capture", "Session", "content_hash"]
