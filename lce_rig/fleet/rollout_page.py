"""The state of a roll-out on one page."""

from lce_rig.fleet.deployment import Rollout
from lce_rig.show.report.page import render


def page(rollout: Rollout) -> str:
    """Write the state of every robot as HTML; those that need somebody come first."""
    order = ("in_place", "rolled_back", "left_out", "waiting")
    states = sorted(
        rollout.robots.values(), key=lambda each: (each.state in order, not each.is_canary, each.robot)
    )
    rows = [
        [
            f"{each.robot} (canary)" if each.is_canary else each.robot,
            each.state.replace("_", " "),
            each.release or "-",
            each.replaces or "-",
            each.time or "-",
            each.detail or "-",
        ]
        for each in states
    ]
    counts = [[state.replace("_", " "), str(n)] for state, n in rollout.counts.most_common()]
    return render("rollout.html", rollout=rollout, rows=rows, counts=counts)
