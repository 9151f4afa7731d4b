"""Sessions on disk: captures that are complete or absent, a journal, a copied profile and a cache."""

from lce_rig.session.capture import Capture, check_capture, content_hash
from lce_rig.session.session import Session, discard_if_empty

__all__ = ["Capture", "Session", "check_capture", "content_hash", "discard_if_empty"]
