"""The lines that `calibrate` prints of a result."""

import json

from hypothesis import given
from hypothesis import strategies as st

from lce_rig.cli.calibrate import _parts
from lce_rig.core.findings import KINDS, Finding
from lce_rig.judge.findings import causes_of
from lce_rig.judge.verdict import with_findings
from tests.export.conftest import calibration

CODES = sorted(code for code in KINDS if code.startswith(("verdict.", "association.")))


@given(
    st.lists(
        st.tuples(st.sampled_from(CODES), st.sampled_from(("note", "warning", "error"))),
        min_size=1,
        max_size=9,
    )
)
def test_calibrate_fail_shows_failing_reason(drawn):
    found = [Finding(code, severity, stored=(f"{code} {k}", "")) for k, (code, severity) in enumerate(drawn)]
    judged = with_findings(calibration(), found)
    if judged.verdict != "fail":
        return
    lines = [
        line
        for line in _parts(judged, "session", {}, is_explained=False, is_of_rig=False)
        if isinstance(line, str)
    ]
    fails = [each.text for each in causes_of(judged.findings) if each.severity == "error"]
    assert any(text in line for text in fails for line in lines)


def test_result_names_a_channel_without_captures(calibrated_once):
    (pair,) = json.loads((calibrated_once / "calibration" / "result.json").read_text())["pairs"]
    (absent,) = (each for each in pair["findings"] if each["code"] == "shortage.channel_absent")
    assert absent["subject"] == "davis.events" and absent["severity"] == "note" and pair["verdict"] == "pass"
