# ruff: noqa: RUF001 (the texts use mathematical signs)
"""The paper's Table 2, with two misprints corrected, and numbers for its adverbs."""

from ffsm_drake.studies.paper.runs import CONTROLLERS

CITATION = (
    "Zhang et al., TDE-Based Adaptive Integral Sliding Mode Control of Space Manipulator for "
    "Space-Debris Active "
    "Removal, Aerospace 9 (2022) 105, doi:10.3390/aerospace9020105"
)


def _row(*values: float) -> dict[str, float]:
    return dict(zip(CONTROLLERS, values, strict=True))


# Disturbance -> controller -> value, corrected.
ITAE = {
    "tau_d1": _row(1.041e-3, 1.913e-3, 4.725e-3, 6.264e-3),
    "tau_d2": _row(1.041e-3, 1.912e-3, 4.726e-3, 6.263e-3),
    "tau_d3": _row(1.041e-3, 1.914e-3, 4.726e-3, 6.264e-3),
}
ISV = {
    "tau_d1": _row(393.9, 387.2, 377.6, 377.2),
    "tau_d2": _row(368.2, 361.3, 351.7, 351.3),
    "tau_d3": _row(489.1, 482.4, 472.8, 472.4),
}

# (metric, disturbance, controller) -> the misprint, and the reason for its correction.
CORRECTIONS = {
    (
        "itae",
        "tau_d3",
        "aismc",
    ): "printed as 1.914×10⁻⁴, which would beat the proposed controller's starred 1.041×10⁻³; "
    "read as 1.914×10⁻³, like its neighbours",
    ("isv", "tau_d3", "tdc"): "printed without the star of the best value, although it is the "
    "smallest of its row",
}

# Interpretation of the paper's adverbs.
NEARLY_TENFOLD = 5.0  # "nearly one order of magnitude": at least this factor
SLIGHTLY = 0.05  # "slightly larger": by at most this fraction
NOTICEABLE = 0.02  # smaller effects count as none
REPRODUCED = 0.03  # largest deviation of a reproduced table, as a fraction
LOCALLY = 0.5  # "only locally": in less than this fraction of time and coordinates
PRECISELY = 1e-5  # "high precision": largest final error, rad and m
ACCURATELY = 0.1  # "accurately estimated": largest relative error
