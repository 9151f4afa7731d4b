"""Compare the results of two independent sessions; check one result on the captures of the other.

python compare_sessions.py SESSION SESSION
"""

import sys

import lce_rig as lce


def main(first: str, second: str) -> None:
    """Print how far the two results differ, and how well the first fits the captures of the second."""
    compared = lce.repeat([first, second])
    for comparison in compared.comparisons:
        print(f"{comparison.camera} and {comparison.lidar}: {'agree' if comparison.agrees else 'disagree'}")
        for two in comparison.differences:
            apart = f"{two.rotation_deg:.3f} deg, {1000 * two.translation_m:.1f} mm"
            print(f"  {two.first} and {two.second}: {apart} (probability {two.p:.2f})")
    result = lce.read_result(f"{first}/calibration/result.json")
    verification = lce.verify(lce.Session.open(second), result)
    for check in verification.checks:
        doubts = "; ".join(finding.text for finding in check.findings)
        print(f"{check.pair} on the captures of {second}: {doubts or 'no contradiction'}")
        for residual in check.residuals:
            plane_mm, edge_mm = 1000 * residual.plane_mean_m, 1000 * residual.edge_mean_m
            print(f"  {residual.capture}: planes {plane_mm:.1f} mm, edges {edge_mm:.1f} mm")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    try:
        main(*sys.argv[1:])
    except lce.LceRigError as error:
        print(error, file=sys.stderr)
        sys.exit(error.exit_code)
