"""A rig on the wire: its senders are scripts, so that benchmarks use them, too."""

from contextlib import ExitStack

import pytest
from wire.reel import make_reel
from wire.rig import WireRig, small_rig

LOOPS_PER_HOLD = 5


@pytest.fixture(scope="session")
def reel(tmp_path_factory):
    """Four places of a board before a VLP-16 and a small camera."""
    return make_reel(tmp_path_factory.mktemp("wire") / "reel", small_rig(), n_placements=4)


@pytest.fixture
def wire(reel, tmp_path):
    """Start a rig on the wire, on which every board that stands still is captured."""
    with ExitStack() as stack:

        def start(**options):
            rig = options.pop("rig", None) or small_rig(is_guided=False)
            return stack.enter_context(WireRig(tmp_path, rig, reel, LOOPS_PER_HOLD, **options))

        yield start
