"""When captures contradict an extrinsic."""

from lce_rig.core.calibration import Metrics
from lce_rig.judge.session_check import contradictions
from lce_rig.rig import load_rig

RIG = load_rig("rlfs")
GOOD = Metrics(mpe_m=0.008, mee_m=0.006, reprojection_px=0.1)


def test_one_board_missed_is_not_reported():
    assert contradictions(GOOD, RIG, n_elsewhere=1, n_seen=30) == ()


def test_boards_elsewhere_are_one_finding():
    (doubt,) = contradictions(GOOD, RIG, n_elsewhere=10, n_seen=30)
    assert (doubt.code, doubt.figures) == ("verify.elsewhere", {"n_elsewhere": 10, "n_captures": 30})


def test_large_residuals_are_named_with_their_limit():
    (doubt,) = contradictions(Metrics(0.05, 0.006, 0.1), RIG, n_elsewhere=0, n_seen=30)
    assert doubt.code == "verdict.plane_residual"
    assert doubt.figures == {"mean_m": 0.05, "limit_m": 0.03}


def test_a_session_without_boards_cannot_agree():
    (doubt,) = contradictions(None, RIG, n_elsewhere=0, n_seen=0)
    assert (doubt.code, doubt.severity) == ("verify.unseen", "error")
