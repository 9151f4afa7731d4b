"""Tables of a result."""

from dataclasses import replace

import pytest

from lce_rig.show.tables import result_tables
from tests.export.conftest import calibration


@pytest.mark.parametrize(("corrected_m", "shown"), [(0.0052, ["5.2 mm"]), (0.0089, []), (float("nan"), [])])
def test_fit_states_planes_without_lidar_errors(corrected_m, shown):
    plain = calibration()
    c = replace(plain, diagnostics=replace(plain.diagnostics, mpe_corrected_m=corrected_m))
    rows = result_tables(c)["fit"].rows
    assert [value for name, value in rows if "without the LiDAR's estimated errors" in name] == shown
