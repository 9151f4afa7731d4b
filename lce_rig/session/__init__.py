"""Sessions on disk: captures that are complete or absent, a journal, a copied profile and a cache."""

from lce_rig.session.capture import Capture
from lce_rig.session.capture_files import content_hash
from lce_rig.session.discarding import discard_if_empty
from lce_rig.session.membership import check_capture
from lce_rig.session.session import Session

__all__ = ["Capture", "Session", "check_capture", "content_hash", "discard_if_empty"]
