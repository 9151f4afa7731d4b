"""Figures published in the LCE-Calib paper, to stand beside what is measured here.

References:
    Jiao et al., "LCE-Calib: Automatic LiDAR-Frame/Event Camera Extrinsic Calibration With a Globally Optimal
    Solution", IEEE/ASME Transactions on Mechatronics, 2023: tables I to III and its figure of noise.
"""

from dataclasses import dataclass

LCE_CALIB, ZHOU_MATLAB, CORNERS = "LCE-Calib (published)", "Zhou-MATLAB (published)", "corners (published)"


@dataclass(frozen=True)
class PublishedRun:
    """One row of the paper's tables: errors against its reference, its mean geometric error, boards found."""

    deg: float
    m: float
    mge_m: float
    detected: str


# Simulated sets by level of noise, 1..10.
NOISE_DEG = {
    LCE_CALIB: (0.0917, 0.0690, 0.0802, 0.0854, 0.2512, 0.1624, 0.1577, 0.2020, 0.2448, 0.4001),
    ZHOU_MATLAB: (0.1451, 0.2814, 0.5673, 0.1921, 0.5355, 0.4638, 0.2535, 1.310, 0.7108, 2.678),
    CORNERS: (0.0893, 0.0903, 0.1051, 0.1379, 0.3799, 0.1996, 0.2730, 0.1982, 0.2311, 1.046),
}
NOISE_MM = {
    LCE_CALIB: (0.38, 0.39, 0.49, 0.75, 7.24, 6.51, 4.56, 6.34, 9.70, 11.93),
    ZHOU_MATLAB: (0.33, 7.94, 13.8, 3.06, 14.6, 11.9, 9.34, 47.6, 22.8, 90.7),
    CORNERS: (0.27, 2.53, 2.63, 3.65, 11.2, 10.6, 8.37, 7.37, 9.81, 34.6),
}
NOISE_MGE_MM = {LCE_CALIB: (1.92, 2.43, 4.01, 6.58, 8.44, 14.67, 10.76, 18.21, 33.36, 47.40)}
NOISE_NORMAL_DEG = {
    LCE_CALIB: (0.0104, 0.0917, 0.229, 0.640, 0.792, 1.653, 1.241, 2.451, 10.50, 12.87),
    ZHOU_MATLAB: (0.0097, 8.71, 10.0, 4.85, 11.8, 7.48, 12.0, 13.5, 12.5, 23.7),
}

# Recorded sets, by the name of the set and the channel.
RECORDED = {
    ("rlfs01", "frames"): {
        LCE_CALIB: PublishedRun(0.130, 0.009, 0.009, "17 of 18"),
        ZHOU_MATLAB: PublishedRun(0.850, 0.026, 0.011, "10 of 18"),
    },
    ("rlfs02", "frames"): {
        LCE_CALIB: PublishedRun(0.293, 0.014, 0.007, "26 of 29"),
        ZHOU_MATLAB: PublishedRun(1.223, 0.042, 0.013, "21 of 29"),
    },
    ("rlfs03", "frames"): {
        LCE_CALIB: PublishedRun(0.136, 0.008, 0.008, "15 of 15"),
        ZHOU_MATLAB: PublishedRun(1.120, 0.041, 0.013, "13 of 15"),
    },
    ("rles01", "frames"): {
        LCE_CALIB: PublishedRun(0.629, 0.032, 0.037, "20 of 20"),
        ZHOU_MATLAB: PublishedRun(1.151, 0.038, 0.036, "20 of 20"),
    },
    ("rles01", "events"): {
        LCE_CALIB: PublishedRun(0.839, 0.041, 0.024, "33 of 36"),
        ZHOU_MATLAB: PublishedRun(1.258, 0.050, 0.023, "33 of 36"),
    },
    ("rles02", "frames"): {
        LCE_CALIB: PublishedRun(0.677, 0.018, 0.031, "34 of 36"),
        ZHOU_MATLAB: PublishedRun(0.927, 0.041, 0.037, "32 of 36"),
    },
    ("rles02", "events"): {
        LCE_CALIB: PublishedRun(0.331, 0.009, 0.028, "34 of 36"),
        ZHOU_MATLAB: PublishedRun(1.270, 0.041, 0.034, "31 of 36"),
    },
    ("rles03", "frames"): {
        LCE_CALIB: PublishedRun(0.781, 0.028, 0.027, "29 of 36"),
        ZHOU_MATLAB: PublishedRun(1.034, 0.039, 0.024, "26 of 36"),
    },
    ("rles03", "events"): {
        LCE_CALIB: PublishedRun(0.554, 0.014, 0.030, "29 of 36"),
        ZHOU_MATLAB: PublishedRun(0.401, 0.016, 0.028, "27 of 36"),
    },
}

# Table III, (EGT_R deg, EGT_t m, MGE m) on RLFS01, RLFS02, RLFS03.
ABLATION = {
    "without point projection": ((0.517, 0.023, 0.015), (0.369, 0.021, 0.015), (0.378, 0.018, 0.016)),
    "without uncertainty model": ((0.119, 0.010, 0.008), (0.338, 0.015, 0.008), (0.207, 0.007, 0.008)),
    "without point-to-plane": ((0.292, 0.011, 0.008), (0.314, 0.012, 0.008), (0.338, 0.016, 0.009)),
    "without point-to-line": ((0.556, 0.018, 0.008), (0.653, 0.021, 0.007), (0.289, 0.019, 0.007)),
    "I = 1": ((0.195, 0.007, 0.009), (0.277, 0.014, 0.008), (0.475, 0.024, 0.008)),
    "I = 5": ((0.262, 0.012, 0.008), (0.342, 0.015, 0.008), (0.324, 0.017, 0.008)),
    "full (I = 100)": ((0.130, 0.009, 0.009), (0.293, 0.014, 0.007), (0.136, 0.008, 0.008)),
}
