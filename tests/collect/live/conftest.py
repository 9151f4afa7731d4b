"""A rig on the wire: its senders are scripts, so that benchmarks use them, too."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from wire.reel import Reel, make_reel
from wire.rig import WireRig, small_rig

LOOPS_PER_HOLD = 5


@pytest.fixture(scope="session")
def reel(tmp_path_factory: pytest.TempPathFactory) -> Reel:
    """Four places of a board before a VLP-16 and a small camera."""
    return make_reel(tmp_path_factory.mktemp("wire") / "reel", small_rig(), n_placements=4)


@pytest.fixture
def wire(reel: Reel, tmp_path: Path) -> Iterator[Callable[..., WireRig]]:
    """Start a rig on the wire, on which every board that stands still is captured."""
    with ExitStack() as stack:

        def start(**options: Any) -> WireRig:
            rig = options.pop("rig", None) or small_rig(is_guided=False)
            return stack.enter_context(WireRig(tmp_path, rig, reel, LOOPS_PER_HOLD, **options))

        yield start
